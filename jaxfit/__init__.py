"""jaxfit: temporally consistent 3D pose and shape of birds from ordinary video, on a CPU.

The public names are listed in `__init__.pyi`. A name is imported at its first use: all modules together take seconds.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
