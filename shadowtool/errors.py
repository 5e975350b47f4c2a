"""Everything that shadowtool raises on purpose.

Each class takes one finished, one-line message: exceptions cross thread and process pools, and
one whose ``__init__`` formats its own message does not survive the trip. A message names the
file, frame or option, says what is wrong, and what to do about it.
"""


class ShadowtoolError(Exception):
    """Base of all; ``exit_code`` is what the command line ends with."""

    exit_code = 1


class InputError(ShadowtoolError):
    """Footage or a product that was given can't be used as it is."""


class MissingError(InputError):
    """A frame that isn't there, or not whole: the rest can do without it, if the user says so."""


class DamagedFileError(MissingError):
    """A file that is there but can't be read whole."""


class OutputExistsError(ShadowtoolError):
    """The output is there already, and neither overwriting nor resuming was asked for."""


class ReshootError(ShadowtoolError):
    """The take itself can't give a usable result."""


class NoLinesError(ReshootError):
    """On the reference plane the shadow's edge has no lines that could be told."""


class OptionError(ShadowtoolError):
    """An option's value, or a combination of options, makes no sense."""

    exit_code = 2


class RetryError(ShadowtoolError):
    """A fault of the machine, not of the job: worth trying again elsewhere or later."""

    exit_code = 75
