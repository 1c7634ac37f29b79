"""Scans and plans on disk. Whatever is wrong with a file comes back as one `InputError` line.

Names are imported when first used, so that the command line can ask which files there are readers
for before anything heavy is imported.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
