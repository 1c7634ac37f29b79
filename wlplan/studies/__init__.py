"""Questions asked of worlds and plans.

Names are imported when first used, so that `import wlplan.studies` is quick.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
