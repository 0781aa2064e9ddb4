"""Numerics of the kernels: small tensors as tuples, SIMD lanes, packed rows, and compilation."""
