"""The commands of `romandask export`: one for each format, collected from the modules of `romandask.export`."""

from __future__ import annotations

import typer
from rich.console import Console

import romandask.export
from romandask.engine.progress import busy
from romandask.export.command import collect_commands, export_command
from romandask.export.options import Folder, StoreArgument
from romandask.report.sky_viewer import write_sky_viewer
from romandask.survey import open_survey


@export_command("page")
def page(store: StoreArgument, out: Folder) -> None:
    """Write the coadds as one zoomable page, both telescopes at the same position: OUT/index.html."""
    path = write_sky_viewer(open_survey(store), out)
    Console().print(f"wrote {path}", highlight=False, soft_wrap=True)


def make_export_app() -> typer.Typer:
    """Return `romandask export` with the commands of all formats, in the order of their names."""
    app = typer.Typer(no_args_is_help=True)

    @app.callback()
    def exporting(context: typer.Context) -> None:
        """Write a survey's contents in other formats."""
        context.with_resource(busy("exporting"))

    # the page is part of the report, which modules of `export` may not import
    commands = [*collect_commands(romandask.export), page]
    for command in sorted(commands, key=lambda command: command.name):
        app.command(command.name)(command.function)
    return app


export_app = make_export_app()
