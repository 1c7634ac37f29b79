"""Differentiable planning of bucket loads for autonomous wheel loaders, in JAX.

A plan is N loadings: where to dig, at which heading, with which parameters of the automatic
bucket-filling controller. A world, learned or simulated, says what each loading yields and what it
leaves of the pile::

    pile = wlplan.read_pile("scan.npz")
    world = wlplan.load_world("low")
    result = wlplan.plan_loads(world, pile, loads=10)
    result.plan, result.rollout.performance, result.cost

Names are imported when first used, so that `import wlplan` is quick.
"""

import lazy_loader

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
