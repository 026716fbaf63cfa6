"""The commands of `romandask export`: one for each format, found in the modules of `romandask.export`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import typer
from rich.console import Console
from typer.core import TyperGroup
from typer.main import get_command

import romandask.export
from romandask.engine.progress import busy
from romandask.export.command import ExportCommand, declared_commands, export_command, load_command
from romandask.export.options import Folder, StoreArgument


@export_command("page")
def page(store: StoreArgument, out: Folder) -> None:
    """Write the coadds as one zoomable page, both telescopes at the same position: OUT/index.html."""
    from romandask.report.sky_viewer import write_sky_viewer
    from romandask.survey import open_survey

    path = write_sky_viewer(open_survey(store), out)
    Console().print(f"wrote {path}", highlight=False, soft_wrap=True)


class _Commands(Mapping[str, Any]):
    """The commands by name. The module of a command is imported when the command is looked up."""

    def __init__(self) -> None:
        self._declared = declared_commands(romandask.export)
        # the page is part of the report, which modules of `export` may not import
        self._loaded = {page.name: _parser(page)}

    def __iter__(self) -> Iterator[str]:
        return iter(sorted({*self._declared, *self._loaded}))

    def __len__(self) -> int:
        return len({*self._declared, *self._loaded})

    def __contains__(self, name: object) -> bool:
        return name in self._declared or name in self._loaded

    def __getitem__(self, name: str) -> Any:
        if name not in self._loaded:
            self._loaded[name] = _parser(load_command(self._declared[name]))
        return self._loaded[name]

    def without_parameters(self) -> dict[str, Any]:
        """Return commands of the same names and help texts, for lists of them; no module is imported."""
        bare = {name: typer.Typer(add_completion=False) for name in self._declared}
        for name, app in bare.items():
            app.command(name, help=self._declared[name].help)(lambda: None)
        commands = self._loaded | {name: get_command(app) for name, app in bare.items()}
        return {name: commands[name] for name in self}


class _ExportGroup(TyperGroup):
    """The group `romandask export`. Its help and the completion of its commands import no module of a format."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        commands: Any = _Commands()
        self.commands = commands

    def format_help(self, ctx: Any, formatter: Any) -> None:
        self._for_lists(ctx).format_help(ctx, formatter)

    def shell_complete(self, ctx: Any, incomplete: str) -> Any:
        return self._for_lists(ctx).shell_complete(ctx, incomplete)

    def _for_lists(self, context: Any) -> TyperGroup:
        """Return the group with bare commands, and make it the one of the context."""
        commands: Any = self.commands
        context.command = TyperGroup(
            name=self.name,
            commands=commands.without_parameters(),
            help=self.help,
            params=self.params,
            rich_markup_mode=self.rich_markup_mode,
            no_args_is_help=self.no_args_is_help,
        )
        return context.command


def _parser(command: ExportCommand) -> Any:
    """Return the click command of a format: an application of one command is that command."""
    app = typer.Typer(add_completion=False)
    app.command(command.name)(command.function)
    return get_command(app)


def make_export_app() -> typer.Typer:
    """Return `romandask export` with the commands of all formats, in the order of their names."""
    app = typer.Typer(cls=_ExportGroup, no_args_is_help=True)

    @app.callback()
    def exporting(context: typer.Context) -> None:
        """Write a survey's contents in other formats."""
        context.with_resource(busy("exporting"))

    return app


export_app = make_export_app()
