"""Help as plain text in two columns, which reads well at 80 characters and in a pipe."""

from __future__ import annotations

import textwrap
from typing import Any

from cyclopts.help import PlainFormatter

_COLUMN = 26
"""Width of the column of option names; longer names stand on a line of their own."""


class TwoColumnFormatter(PlainFormatter):
    """Formatter of the help for `cyclopts.App`."""

    def render_description(self, console: Any, options: Any, description: Any) -> None:
        """Print the description of a command."""
        console.print(textwrap.fill(str(description.primary_renderable), console.width), markup=False, highlight=False)

    def __call__(self, console: Any, options: Any, panel: Any) -> None:
        """Print a group of options or commands."""
        if not panel.entries:
            return
        lines = ["", f"{panel.title}:"]
        for entry in panel.entries:
            name = "  " + ", ".join(entry.display_labels_with_metavar)
            description = textwrap.wrap(_description(entry), max(console.width - _COLUMN, 24), break_on_hyphens=False)
            if len(name) < _COLUMN - 1 and description:
                name = f"{name:<{_COLUMN}}{description.pop(0)}"
            lines += [name, *(" " * _COLUMN + line for line in description)]
        console.print("\n".join(lines), markup=False, highlight=False, soft_wrap=True)


def _description(entry: Any) -> str:
    """Return the help text of an option, with its choices and its default."""
    text = getattr(entry.description, "primary_renderable", entry.description)
    parts = [" ".join(str(text).split())]
    if entry.choices:
        parts.append(f"(one of: {', '.join(entry.choices)})")
    if entry.default not in (None, "None", "False", "()"):
        parts.append(f"(default: {entry.default})")
    return " ".join(part for part in parts if part)
