"""The run-time checker of annotations, as the import hook in conftest.py wants it: a name in a module."""

from __future__ import annotations

from beartype import BeartypeConf, beartype

__all__ = ["check"]

check = beartype(conf=BeartypeConf(is_pep484_tower=True))
"""An int is accepted where a float is asked for, as type checkers do."""
