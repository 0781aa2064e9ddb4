"""Convergence of cqrun's frames: independent references, and a harness that measures scenes against them.

    python -m benchmarks.convergence.references     # finite-element references -> references.json
    python -m benchmarks.convergence                # measured points -> benchmarks/measured/convergence.csv, and plots
"""
