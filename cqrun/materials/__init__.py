"""Constitutive terms, one file each: Kirchhoff stress and its adjoint on small tensors."""
