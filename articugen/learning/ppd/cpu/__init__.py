"""Kernels that make PPD quick without a GPU."""
