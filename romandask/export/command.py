"""Declaration and collection of the commands of `romandask export`."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable, Iterable
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


def collect_commands(package: ModuleType) -> list[ExportCommand]:
    """Import all modules of a package and return the commands that they declare.

    Parameters
    ----------
    package : module
        Package whose modules are searched; its subpackages are not.

    Returns
    -------
    list of ExportCommand
        Commands in the order of their names.

    Raises
    ------
    ValueError
        If two commands have the same name.
    """
    commands: dict[str, ExportCommand] = {}
    for module in pkgutil.iter_modules(package.__path__, f"{package.__name__}."):
        for value in vars(importlib.import_module(module.name)).values():
            if not isinstance(value, ExportCommand):
                continue
            # an imported command is found twice, and is the same object
            if commands.setdefault(value.name, value) is not value:
                raise ValueError(f"{module.name}: the command {value.name!r} is declared twice")
    return [commands[name] for name in sorted(commands)]


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
