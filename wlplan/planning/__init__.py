"""Jobs, objectives, planners, and what plays a plan.

The planners are in `wlplan.planners`, which is imported when it is first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, submodules=["planners"])
