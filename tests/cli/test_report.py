"""What a step prints when it is done."""

import json
from pathlib import Path

import pytest

from shadowtool.cli.report import report
from shadowtool.steps.run import Result

FIGURES = {
    "gains": {str(1001 + n): 0.9 + n / 100 for n in range(20)},
    "tints": {str(1001 + n): [1.0, 1 + n / 100, 0.99] for n in range(20)},
    "lines": {"first": 3.5, "last": 9.0},
    "settings": {"abcdefghi"[n]: {"at": n} for n in range(9)},
    "left_out": None,
    "dropped": [],
}


def printed(capsys: pytest.CaptureFixture[str], as_json: bool) -> str:
    report([Result("plate", Path("out"), [1001, 1002], 1, [1003], FIGURES)], as_json)
    return capsys.readouterr().out


def test_figures_of_many_frames_are_summed_up(capsys: pytest.CaptureFixture[str]) -> None:
    assert printed(capsys, as_json=False).splitlines() == [
        "plate: out, frames 1001-1002, 1 up to date, SKIPPED 1003",
        "  gains: 20 frames, 0.9 to 1.09",
        "  tints: 20 frames, 1 to 1, 1 to 1.19, 0.99 to 0.99",
        "  lines: first 3.5, last 9.0",
        "  settings: a at 0, b at 1, c at 2, d at 3, e at 4, f at 5, g at 6, h at 7, i at 8",
        "  left out: none",
        "  dropped: none",
    ]


def test_json_holds_them_all(capsys: pytest.CaptureFixture[str]) -> None:
    row = json.loads(printed(capsys, as_json=True))
    assert row["figures"] == FIGURES
    assert row["skipped"] == "1003"
