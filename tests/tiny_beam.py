"""The scene of a tiny beam that hangs from a clamp for a tenth of a second, for tests of many runs."""

BEAM = """
cqrun: 1
world: {size: [0.4, 0.3], dx: 0.02, gravity: [0, -9.81]}
bodies:
  beam:
    shape: {box: {corner: [0.02, 0.2], size: [0.2, 0.04]}}
    particles_per_cell: 4
    material: {density: 1000, elastic: {neo_hookean: {youngs_modulus: 5.0e4, poissons_ratio: 0.3}}}
boundaries:
  clamp: {sticky: {region: {box: {corner: [0, 0], size: [0.04, 0.3]}}}}
time: {duration: 0.1, control_step: 0.01}
"""
E, NU = (f"bodies.beam.material.elastic.neo_hookean.{name}" for name in ("youngs_modulus", "poissons_ratio"))
