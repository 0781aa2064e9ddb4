"""The options of pictures; a module without heavy imports, so that the command line can use it."""

from typing import Literal

Quantity = Literal[
    "activation", "strain", "velocity", "stiffness", "density", "poissons_ratio", "weight", "displacement"
]  # fmt: skip
"""Quantities that can colour the particles."""

Look = Literal["front", "side", "top", "iso"]
"""Directions of view in 3D."""

Kind = Literal["gif", "mp4", "png", "stills", "onion"]
"""Kinds of pictures of a motion."""
