"""Effects that a model of the motion may have or lack; every module of this package is read: a new file suffices."""

from importlib import import_module
from pkgutil import iter_modules

for _module in iter_modules(__path__):
    import_module(f"{__name__}.{_module.name}")
