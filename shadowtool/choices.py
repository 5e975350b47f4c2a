"""The words that options take, and defaults: one table for the code and for the command line.

It imports nothing heavy, so that ``--help`` answers at once.
"""

from typing import Literal, get_args

Beta = Literal["scalar", "rgb"]
Estimator = Literal["robust", "minmax"]
Fill = Literal["inpaint", "lit", "none"]
Format = Literal["exr", "png"]
Gain = Literal["auto", "none"]
Missing = Literal["error", "skip"]
Only = Literal["trimap", "alpha", "beta"]
Reading = Literal["auto", "plane", "card"]
Steady = Literal["auto", "none"]
TransferName = Literal["auto", "linear", "srgb", "rec709", "none"]
Progress = Literal["auto", "bar", "plain", "openjd", "none"]

BETAS: tuple[str, ...] = get_args(Beta)
ESTIMATORS: tuple[str, ...] = get_args(Estimator)
FILLS: tuple[str, ...] = get_args(Fill)
FORMATS: tuple[str, ...] = get_args(Format)
GAINS: tuple[str, ...] = get_args(Gain)
MISSING: tuple[str, ...] = get_args(Missing)
ONLY: tuple[str, ...] = get_args(Only)
READINGS: tuple[str, ...] = get_args(Reading)
STEADY: tuple[str, ...] = get_args(Steady)
TRANSFER_NAMES: tuple[str, ...] = get_args(TransferName)
PROGRESS: tuple[str, ...] = get_args(Progress)

# Of the diffusion that smooths a map; and the value of what a map points to outside the frame.
ITERATIONS, OUTSIDE = 5, 1.0
