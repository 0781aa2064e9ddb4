"""A soft block with two muscles and a cable, on which a free rigid disc falls: a controller's scene in a second."""

from __future__ import annotations

from typing import Any

STIFFNESS = "actuators.pull.cable.stiffness"
MODULUS = "bodies.block.material.elastic.neo_hookean.youngs_modulus"

DISC: dict[str, Any] = {
    "cqrun": 1,
    "job": "control",
    "world": {"size": [0.2, 0.14], "dx": 0.02, "gravity": [0, -9.81], "frame": "reference"},
    "bodies": {
        "block": {
            "shape": {"box": {"corner": [0.04, 0.04], "size": [0.12, 0.04]}},
            "particles_per_cell": 4,
            "material": {
                "density": 1000,
                "elastic": {"neo_hookean": {"youngs_modulus": 3.0e4, "poissons_ratio": 0.3}},
                "viscosity": {"shear": 20},
            },
        }
    },
    "boundaries": {"floor": {"sticky": {"region": {"box": {"corner": [0, 0], "size": [0.2, 0.05]}}}}},
    "rigid": {
        "disc": {
            "shape": {"ball": {"center": [0.09, 0.0995], "radius": 0.02}}, "motion": "free", "density": 800,
            "velocity": [0.0, -0.05],
        }
    },
    "actuators": {
        "left": {"muscle": {"body": "block", "region": {"box": {"corner": [0.04, 0.04], "size": [0.06, 0.04]}},
                            "axis": [0, 1], "strength": 3.0e3}},
        "right": {"muscle": {"body": "block", "region": {"box": {"corner": [0.1, 0.04], "size": [0.06, 0.04]}},
                             "axis": [0, 1], "strength": 3.0e3}},
        "pull": {"cable": {"body": "block", "route": [[0.05, 0.07], [0.15, 0.07]], "stiffness": 500}},
    },
    "measure": {
        "place": {"rigid_motion": {"rigid": "disc"}}, "speed": {"rigid_motion": {"rigid": "disc", "of": "velocity"}},
        "turn": {"rigid_motion": {"rigid": "disc", "of": "rotation"}},
        "push": {"reaction": {"boundary": "disc"}},
        "weight": {"reaction": {"boundary": "floor", "on": "boundary"}},
        "tilt": {"reaction": {"boundary": "floor", "of": "moment"}}, "pull": {"cable_tension": {"cable": "pull"}},
    },
    "controller": {"linear_tanh": {"spread": 0.5}},
    "objective": {"still": {"measured": {"quantity": "place", "target": [0.01, 0.0], "over": "mean", "weight": 1.0e3}}},
    "unknowns": {MODULUS: {"bounds": [1.0e4, 1.0e5]}, STIFFNESS: {"bounds": [100, 1000]}},
    "time": {"duration": 0.1, "control_step": 0.01},
    "optimizer": {"adam": {"max_iterations": 2}},
}  # fmt: skip

MOTION = {
    "place": {"measured": {"quantity": "place", "range": [-0.01, 0.01]}},
    "speed": {"measured": {"quantity": "speed", "range": [-0.2, 0.2]}},
}
FORCES = {name: {"measured": {"quantity": name}} for name in ("push", "weight", "tilt")}
TENSION = {"pull": {"measured": {"quantity": "pull"}}}
SEEN = {"motion": MOTION, "forces": FORCES, "tension": TENSION}
