"""The page `cqrun describe units`: the units of a scene, how to convert to them, and what is often confused."""

UNITS = """\
units of a scene

  A scene has bare numbers in SI units, without prefixes. `cqrun describe` shows the unit of each field in brackets.

  quantity                     unit     written in a scene
  length                       m        20 mm = 0.02, 5 cm = 0.05, 1 inch = 0.0254
  time                         s        5 ms = 0.005
  mass                         kg       20 g = 0.02
  density                      kg/m^3   1.07 g/cm^3 = 1070 (1 g/cm^3 = 1000 kg/m^3)
  modulus, pressure, stress    Pa       180 kPa = 1.8e5, 1.2 MPa = 1.2e6, 1 N/mm^2 = 1e6, 1 bar = 1e5, 1 psi = 6895
  viscosity                    Pa s     1 mPa s = 0.001
  force                        N        50 mN = 0.05, 10 g weigh 0.0981
  torque                       N m
  moment of inertia            kg m^2
  stiffness of a spring        N/m      0.3 N/mm = 300
  velocity, acceleration       m/s, m/s^2
  rate, frequency              1/s, Hz
  angle of a place or a shape  deg      a quarter turn = 90
  rotation of a clamp, spin    rad, rad/s   a quarter turn = 1.5708
  ratio, share, count          1

  Numbers can have an exponent: 1.8e5 is 180,000. Amounts of memory have a unit of their own, such as 8GiB.

units in 2D

  A 2D scene is a slice of material, 1 m deep (plane strain). Densities, moduli, pressures and viscosities are those of
  the 3D material. Forces, masses and the stiffness of springs are per metre of depth: N means N/m, and kg means kg/m.
  To describe a body of another depth, divide its forces and masses by the depth: 0.5 N on a beam 20 mm deep = 25.

common mistakes

  density 1.07               is g/cm^3: write 1070. A body that is a thousand times too light asks for tiny substeps
  youngs_modulus 180         is kPa: write 1.8e5. The body is flattened by its weight
  size [150, 20]             is mm: write [0.15, 0.02]. For a mesh in mm, give `units: mm`
  gravity [0, 9.81]          points up: write [0, -9.81]
  a recording in mm          give the recording `units: mm` (m, cm or mm) if its file does not name them
  hardness (Shore A or 00)   is no modulus: fit youngs_modulus to a recording, or read it from a tensile test

  `cqrun validate` asks about numbers that look like another unit.

other units

  Any consistent units may be used, such as cm, g and s, or numbers without dimension as in the two ChainQueen papers.
  All results are then in these units, although cqrun labels them with SI units."""
