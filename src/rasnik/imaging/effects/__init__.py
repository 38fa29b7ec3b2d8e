"""The sources of error of section 3 of the paper, each by name, and what else real images show.

`EFFECTS` is the table of all of them; `make_effects` makes them from names and values.
"""

from rasnik.imaging.effects import (  # isort: skip  # in the order an image meets them
    mask,
    air,
    optics,
    light,
    geometry,
    response,
    readout,
)
from rasnik.imaging.effects.base import EFFECTS, Context, Effect, Info, effects_markdown
from rasnik.imaging.effects.chain import Chain, make_effect, make_effects

__all__ = [
    "EFFECTS",
    "Chain",
    "Context",
    "Effect",
    "Info",
    "air",
    "effects_markdown",
    "geometry",
    "light",
    "make_effect",
    "make_effects",
    "mask",
    "optics",
    "readout",
    "response",
]
