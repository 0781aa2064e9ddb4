"""Kernels' numbers: small tensors as tuples, SIMD lanes, packed rows, and how kernels compile."""

from cqrun.fingerprint import set_kernel_cache

set_kernel_cache()  # before any kernel is defined
