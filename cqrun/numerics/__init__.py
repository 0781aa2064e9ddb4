"""Kernels' numbers: small tensors as tuples, SIMD lanes, packed rows, and how kernels compile."""
