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
from importlib.resources import files
from importlib.util import LazyLoader, find_spec, module_from_spec
from types import ModuleType
from typing import Any


def _when_used(name: str) -> ModuleType:
    """A module that is executed when something in it is first asked for."""
    spec = find_spec(name)
    if name in sys.modules or spec is None or spec.loader is None:
        return import_module(name)
    spec.loader = LazyLoader(spec.loader)
    module = module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
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
