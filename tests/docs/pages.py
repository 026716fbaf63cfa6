"""The pages of the documentation, and the blocks of code in them."""

from __future__ import annotations

import re
from dataclasses import dataclass

from conftest import ROOT

PAGES = tuple(
    path.relative_to(ROOT).as_posix()
    for path in (
        ROOT / "README.md",
        ROOT / "CONTRIBUTING.md",
        *sorted(ROOT.glob("pipelines/README.md")),
        *sorted(ROOT.glob("catalogs/README.md")),
        *sorted(ROOT.glob("romandask/**/README.md")),
        *sorted(path for path in (ROOT / "docs").rglob("*.md") if "_build" not in path.parts),
    )
)
"""Paths relative to the repository."""
_BLOCK = re.compile(
    r"(?:^<!-- not executed:(?P<reason>[^>]*)-->\n+)?^```(?P<kind>bash|python)\n(?P<text>.*?)^```$", re.M | re.S
)


@dataclass(frozen=True)
class Block:
    """A block of code of one page."""

    page: str
    kind: str
    """bash or python"""
    text: str
    reason: str | None
    """Why it is not executed; None where it is."""

    @property
    def commands(self) -> list[str]:
        """The lines of a bash block that call romandask."""
        return [line for line in self.text.splitlines() if line.startswith("romandask ")]


def blocks(kind: str, page: str | None = None) -> list[Block]:
    """Return the blocks of one kind, of one page or of all."""
    found = []
    for name in PAGES if page is None else (page,):
        for match in _BLOCK.finditer((ROOT / name).read_text()):
            if match["kind"] == kind:
                reason = match["reason"]
                found.append(Block(name, kind, match["text"], None if reason is None else reason.strip()))
    return found
