"""How far a step is, on stderr."""

import pytest

from shadowtool.cli.progress import reporter


def test_openjd_progress_does_not_fall_when_a_take_is_read_again(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with reporter("openjd", "scan") as advance:
        for done in (0, 2, 4, 0, 2, 4):
            advance(done, 4)
    lines = capsys.readouterr().err.splitlines()
    parts = [float(line.removeprefix("openjd_progress: ")) for line in lines]
    assert parts == [0, 50, 100, 100, 100, 100]
