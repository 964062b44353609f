"""Optional effects of a model of the motion. All modules of this package are imported: a new file is sufficient."""

from importlib import import_module
from pkgutil import iter_modules

for _module in iter_modules(__path__):
    import_module(f"{__name__}.{_module.name}")
