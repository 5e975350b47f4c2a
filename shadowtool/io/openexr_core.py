"""What OpenEXR's C library can do and its Python binding leaves out."""

import ctypes
from typing import Any

import OpenEXR


def set_zip_level(level: int) -> None:
    """How hard ZIP searches, for all threads.

    A build that hides this writes the same pixels, in more time.
    """
    if setter := _function("exr_set_default_zip_compression_level"):
        setter(level)


def inflating() -> int | None:
    """The address of ``exr_uncompress_buffer``; None where a build hides it."""
    return _address("exr_uncompress_buffer")


def deflating() -> int | None:
    """The address of ``exr_compress_buffer``; None where a build hides it."""
    return _address("exr_compress_buffer")


def _address(name: str) -> int | None:
    return ctypes.cast(_function(name), ctypes.c_void_p).value


def _function(name: str) -> Any:
    """None where the build hides it."""
    try:
        return ctypes.CDLL(OpenEXR.__file__)[name]
    except (OSError, AttributeError):
        return None
