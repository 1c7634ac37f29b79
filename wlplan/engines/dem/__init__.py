"""A discrete-element engine as a World: soil as thousands of spheres, dug in closed loop.

The engine is LAMMPS, which is GPL-2 and installed by the user. `dem.engine` alone imports it, in a
process of its own that `dem.process` starts and talks to by files. What that process imports, which
is all but `dem.process` and `dem.world`, needs NumPy and SciPy and not JAX.
"""
