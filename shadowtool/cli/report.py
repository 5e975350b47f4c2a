"""A step's result on stdout, as text or JSON."""

import json
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from shadowtool.steps.run import Result

# Figures of more frames than this are summed up; --json gives them all.
_MANY = 8


def report(results: Iterable["Result"], as_json: bool) -> None:
    """Print what the steps did."""
    rows = [_row(result) for result in results]
    if as_json:
        click.echo(json.dumps(rows[0] if len(rows) == 1 else rows, indent=1, sort_keys=True))
        return
    for row in rows:
        click.echo(_headline(row))
        for name, value in row["figures"].items():
            click.echo(f"  {name.replace('_', ' ')}: {_text(value)}")


def _row(result: "Result") -> dict[str, Any]:
    from shadowtool.io.sequence import frame_range

    return {
        "step": result.step,
        "output": str(result.output),
        "frames": frame_range(result.frames) if result.frames else "",
        "kept": result.kept,
        "skipped": frame_range(result.skipped) if result.skipped else "",
        "figures": result.figures,
    }


def _headline(row: dict[str, Any]) -> str:
    parts = [f"{row['step']}: {row['output']}"]
    if row["frames"]:
        parts.append(f"frames {row['frames']}")
    if row["kept"]:
        parts.append(f"{row['kept']} up to date")
    if row["skipped"]:
        parts.append(f"SKIPPED {row['skipped']}")
    return ", ".join(parts)


def _text(value: Any) -> str:
    from shadowtool.io.sequence import frame_number

    if isinstance(value, dict):
        if len(value) > _MANY and all(frame_number(name) is not None for name in value):
            return f"{len(value)} frames, {_range(value.values())}"
        return ", ".join(f"{k.replace('_', ' ')} {_text(v)}" for k, v in value.items()) or "none"
    if isinstance(value, list):
        return ", ".join(map(_text, value)) or "none"
    return "none" if value is None else str(value)


def _range(values: Iterable[Any]) -> str:
    """Of many frames' figures, numbers or lists of them, from where to where they go."""
    columns = zip(*(value if isinstance(value, list) else [value] for value in values), strict=True)
    return ", ".join(f"{min(column):g} to {max(column):g}" for column in columns)
