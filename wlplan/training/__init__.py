"""Training and evaluating the learned models. Paper, section 6.4.

A trained model is saved as a directory, see `wlplan.models.storage`. A training that
was cut short continues where it stopped and ends with the same weights::

    settings = PsiLowSettings(members=5, epochs=40)
    model, report = train(settings, open_dataset("data.zarr"), out="my-psi-low")

Names are imported when first used: the settings can be had without JAX.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
