"""The same substep of MLS-MPM, forward and backward, for cqrun and its living peers, side by side.

    python -m benchmarks.peers [--sizes 2d_6400 3d_8000 ...] [--repeat 5] [--output FILE]

problem.py      the block that falls, and what every implementation has to give: a loss and two gradients
taichi_mpm.py, warp_mpm.py, jax_mpm.py   written from the equations (CQ1 eqs 1 to 12), float32, as their makers advise
cqrun_mpm.py    cqrun itself, float64; as `cqrun_float32` it computes as the peers do
worker.py       one implementation in a process of its own, pinned to one core
"""
