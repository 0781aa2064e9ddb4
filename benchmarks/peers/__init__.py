"""The same substep of MLS-MPM, forward and backward, in cqrun and in other simulators that are still developed.

    python -m benchmarks.peers [--sizes 2d_6400 3d_8000 ...] [--repeat 5] [--output FILE]

problem.py      the falling block, and what every implementation computes: a loss and two gradients
taichi_mpm.py, warp_mpm.py, jax_mpm.py   from the equations (CQ1 eqs 1 to 12), in float32, as their manuals advise
cqrun_mpm.py    cqrun itself, in float64, and as `cqrun_float32` in the peers' precision
worker.py       runs one implementation in a process of its own, pinned to one core
"""
