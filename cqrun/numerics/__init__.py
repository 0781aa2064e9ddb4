"""Numerics of the kernels: small tensors as tuples, SIMD lanes, packed rows, and compilation."""

from cqrun.fingerprint import set_kernel_cache

set_kernel_cache()  # before any kernel is defined
