"""What a user may choose of pictures; light, so that the command line can name it without importing what draws."""

from typing import Literal

Quantity = Literal[
    "activation", "strain", "velocity", "stiffness", "density", "poissons_ratio", "weight", "displacement"
]  # fmt: skip
"""What colours the particles."""

Look = Literal["front", "side", "top", "iso"]
"""From where a world of three dimensions is seen."""

Kind = Literal["gif", "mp4", "png", "stills", "onion"]
"""What is made of a motion."""
