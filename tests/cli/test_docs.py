import re

import pytest

from shadowtool.cli.commands import COMMANDS
from tests.cli.reference import BLOCK, README, help_text, with_reference

TEXT = README.read_text()


def test_the_readme_says_what_help_says() -> None:
    assert BLOCK.search(TEXT)
    assert with_reference(TEXT) == TEXT, "run `make readme`"


@pytest.mark.parametrize("command", COMMANDS)
def test_every_option_is_explained(command: str) -> None:
    listing = help_text(command).partition("Options:")[2]
    for option in re.split(r"\n  (?=-)", listing)[1:]:
        assert len(option.split()) > 3, option


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_the_common_options(command: str) -> None:
    text = help_text(command)
    for option in ("--output", "--frames", "--jobs", "--overwrite", "--resume", "--progress"):
        assert option in text


def test_pictures_in_the_readme_exist() -> None:
    pictures = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", TEXT)
    assert pictures
    for picture in pictures:
        assert (README.parent / picture).is_file(), picture
