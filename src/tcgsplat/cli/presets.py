"""`tcgsplat presets`: what the presets are, and where each of their values is from."""

import sys
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from shutil import get_terminal_size

import tyro


@dataclass(frozen=True)
class Args:
    """List the presets, or all values of one with their origins."""

    name: tyro.conf.Positional[str] = ""
    """A preset; leave it out for the list."""


def command(args: Args) -> int:
    """Print to standard output."""
    from tcgsplat import presets
    from tcgsplat.config import value_text

    if not args.name:
        width = max(map(len, presets.PRESETS))
        sys.stdout.writelines(f"{name:<{width}}  {presets.SUMMARIES[name]}\n" for name in presets.PRESETS)
        sys.stdout.write("\n`tcgsplat presets NAME` shows every value of one and where it is from.\n")
        return 0
    rows = [(s.path, value_text(s.value), s.origin, s.reason) for s in presets.origins(args.name)]
    sys.stdout.write("\n".join(_table(rows)) + "\n")
    sys.stdout.write("\npaper: stated there; base: the base system's (LoopSplat); ours: stated in neither.\n")
    return 0


def _table(rows: Sequence[tuple[str, str, str, str]]) -> list[str]:
    """Columns; the last one wrapped on a terminal, on one line in a pipe."""
    widths = [max(len(row[column]) for row in rows) for column in range(3)]
    indent = sum(widths) + 6
    room = max(get_terminal_size().columns - indent, 40) if sys.stdout.isatty() else 10_000
    lines = []
    for *cells, reason in rows:
        head = "  ".join(f"{cell:<{width}}" for cell, width in zip(cells, widths, strict=True))
        first, *others = textwrap.wrap(reason, room) or [""]
        lines += [f"{head}  {first}".rstrip(), *(" " * indent + other for other in others)]
    return lines
