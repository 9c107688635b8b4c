"""What a package exports, imported when it is first asked for (PEP 562).

A package lists what it exports once, as imports in its `__init__.pyi`, which type checkers read as well
(Scientific Python, SPEC 1: Lazy loading of submodules and functions). Its `__init__.py` holds

    __getattr__, __dir__, __all__ = exported(__name__)
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.resources import files
from importlib.util import find_spec, module_from_spec, spec_from_loader
from types import ModuleType
from typing import Any

# What a module's code makes, and where imports of its submodules look. Another double-underscored name must
# not execute it: `import torch` asks everything in `sys.modules` for `__file__` (`inspect.getmodule`), and a
# module that was executed there would find torch half imported.
MADE_BY_CODE = frozenset({"__all__", "__dict__", "__doc__", "__path__"})


class _WhenUsed(ModuleType):
    """A module that is executed when something in it is first asked for."""

    def __getattribute__(self, name: str) -> Any:
        if name.startswith("__") and name.endswith("__") and name not in MADE_BY_CODE:
            return super().__getattribute__(name)
        self.__class__ = ModuleType  # type: ignore[assignment]
        self.__spec__.loader.exec_module(self)  # type: ignore[union-attr]
        return getattr(self, name)

    def __setattr__(self, name: str, value: Any) -> None:
        if name != "__class__":
            vars(self)  # executes it, which would otherwise undo what is set here
        object.__setattr__(self, name, value)

    def __reduce__(self) -> tuple[Callable[[str], ModuleType], tuple[str]]:
        """As cloudpickle sends a module to another process, which knows this class as no module."""
        return import_module, (self.__name__,)


class _Loaded(Loader):
    """Gives a module that was executed already."""

    def __init__(self, module: ModuleType) -> None:
        self.module, self.spec = module, module.__spec__

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return self.module

    def exec_module(self, module: ModuleType) -> None:
        module.__spec__ = self.spec


class _OnceOnly(MetaPathFinder):
    """Finds a submodule that its package has imported while it was asked where to look for it.

    The import of a submodule asks for the package's `__path__`, which executes a package that has not been
    used. What that imports would be executed once more, and its classes and kernels be others than those
    that the package has.
    """

    def find_spec(self, name: str, path: Any = None, target: ModuleType | None = None) -> ModuleSpec | None:
        module = sys.modules.get(name) if name.startswith(f"{__package__}.") and target is None else None
        return None if module is None else spec_from_loader(name, _Loaded(module))


sys.meta_path.insert(0, _OnceOnly())


def _when_used(name: str) -> ModuleType:
    spec = find_spec(name)
    if name in sys.modules or spec is None or spec.loader is None:
        return import_module(name)
    module = module_from_spec(spec)
    module.__class__ = _WhenUsed
    sys.modules[name] = module
    return module


def exported(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """`__getattr__`, `__dir__` and `__all__` of a package, from the imports in its `__init__.pyi`."""
    stub = ast.parse(files(package).joinpath("__init__.pyi").read_text(encoding="utf-8"))
    homes = {
        alias.name: node.module
        for node in stub.body
        if isinstance(node, ast.ImportFrom) and node.module
        for alias in node.names
    }

    def get(name: str) -> Any:
        home = homes.get(name)
        if home is None:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        if home == package:
            value: Any = _when_used(f"{home}.{name}")
        else:
            module = import_module(home)
            value = getattr(module, name) if hasattr(module, name) else import_module(f"{home}.{name}")
        setattr(sys.modules[package], name, value)
        return value

    return get, lambda: sorted({*vars(sys.modules[package]), *homes}), sorted(homes)
