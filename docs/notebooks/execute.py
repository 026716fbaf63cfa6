"""Execute the notebooks and store their output.

Run it in a folder that holds the finished store `runs/tiny`.
"""

import os
from pathlib import Path

import nbformat
from nbclient import NotebookClient


def execute(path: Path) -> nbformat.NotebookNode:
    """Return a notebook, executed in the working directory, without what depends on the machine or on the time."""
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": os.getcwd()}}).execute()
    for cell in notebook.cells:
        cell.metadata = {}
        if cell.cell_type == "code":
            # progress bars
            cell.outputs = [output for output in cell.outputs if output.get("name") != "stderr"]
    notebook.metadata.get("language_info", {}).pop("version", None)
    return notebook


def main() -> None:
    """Execute every notebook of this folder."""
    for path in sorted(Path(__file__).resolve().parent.glob("*.ipynb")):
        nbformat.write(execute(path), path)
        print(path.name, path.stat().st_size)


if __name__ == "__main__":
    main()
