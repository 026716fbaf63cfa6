"""The Python of every page runs, the blocks of a page one after another in one namespace."""

import pytest
from pages import PAGES, blocks

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("default")]
WITH_PYTHON = [page for page in PAGES if any(block.reason is None for block in blocks("python", page))]


@pytest.mark.parametrize("page", WITH_PYTHON)
def test_python_of_a_page_runs(page, tiny_store, tmp_path, monkeypatch):
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "tiny").symlink_to(tiny_store)
    monkeypatch.chdir(tmp_path)
    namespace = {"__name__": "page"}
    for block in blocks("python", page):
        if block.reason is None:
            exec(compile(block.text, page, "exec"), namespace)
