"""Convergence of cqrun's frames: independent references, and a harness that measures scenes against them.

`python -m benchmarks.convergence.references` computes the finite-element references (references.json), and
`python -m benchmarks.convergence` measures the points (benchmarks/measured/convergence.csv) and draws them.
"""
