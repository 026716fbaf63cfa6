"""Declaration and discovery of the commands of `romandask export`."""

from __future__ import annotations

import ast
import importlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

from rich.console import Console

from romandask.export import sha256sums


@dataclass(frozen=True)
class ExportCommand:
    """A command of `romandask export`."""

    name: str
    """Name on the command line, for example `coadd-psf`."""
    function: Callable[..., None]
    """Typer function: its annotated parameters are the arguments, its docstring is the help text."""


def export_command(name: str) -> Callable[[Callable[..., None]], ExportCommand]:
    """Declare the decorated function as the command `romandask export NAME`.

    Parameters
    ----------
    name : str
        Name on the command line.

    Returns
    -------
    callable
        Decorator that turns a typer function into an `ExportCommand`.
    """

    def declare(function: Callable[..., None]) -> ExportCommand:
        return ExportCommand(name, function)

    return declare


@dataclass(frozen=True)
class DeclaredCommand:
    """A command as the source of its module declares it."""

    name: str
    """Name on the command line."""
    help: str
    """Help text."""
    module: str
    """Module that holds the command."""


def declared_commands(package: ModuleType) -> dict[str, DeclaredCommand]:
    """Return the commands that the modules of a package declare, by name, without importing the modules.

    The modules import the libraries of their formats, which takes seconds; their sources are parsed instead.

    Parameters
    ----------
    package : module
        Package whose modules are searched; its subpackages are not.

    Returns
    -------
    dict of str to DeclaredCommand
        Commands in the order of their names.

    Raises
    ------
    ValueError
        If two commands have the same name.
    """
    commands: dict[str, DeclaredCommand] = {}
    for path in sorted(path for folder in package.__path__ for path in Path(folder).glob("*.py")):
        for name, text in _declared_in(path.read_text(encoding="utf-8")):
            if name in commands:
                raise ValueError(f"{path.name}: the command {name!r} is declared twice")
            commands[name] = DeclaredCommand(name, text, f"{package.__name__}.{path.stem}")
    return {name: commands[name] for name in sorted(commands)}


def _declared_in(source: str) -> Iterator[tuple[str, str]]:
    """Yield the name and the help text of each function decorated with `export_command`."""
    if f"@{export_command.__name__}(" not in source:
        return
    for node in ast.parse(source).body:
        for decorator in node.decorator_list if isinstance(node, ast.FunctionDef) else ():
            if isinstance(decorator, ast.Call) and ast.unparse(decorator.func) == export_command.__name__:
                assert isinstance(node, ast.FunctionDef)
                yield ast.literal_eval(decorator.args[0]), ast.get_docstring(node) or ""


def load_command(declared: DeclaredCommand) -> ExportCommand:
    """Import the module of a command and return the command."""
    values = vars(importlib.import_module(declared.module)).values()
    return next(value for value in values if isinstance(value, ExportCommand) and value.name == declared.name)


def report_written(paths: Iterable[Path], content: str = "") -> None:
    """Record the checksums of written files, and print a line for each file.

    Parameters
    ----------
    paths : iterable of Path
        Written files. The checksum of each file is added to the SHA256SUMS of its folder.
    content : str
        Content of the files as the lines name it, for example `12 visits`; by default a line names the file alone.

    Raises
    ------
    UserError
        If SHA256SUMS cannot be written or is damaged.
    """
    for path in paths:
        sha256sums.note(path)
        Console().print(f"wrote {content} to {path}" if content else f"wrote {path}", highlight=False, soft_wrap=True)
