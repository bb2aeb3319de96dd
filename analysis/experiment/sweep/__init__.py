"""Sweeps and multisines: linear coupling of a chain, and best linear approximations of joints."""
