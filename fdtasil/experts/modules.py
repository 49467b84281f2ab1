"""Torch modules as experts: copies of them, which the caller's own training does not change."""

import copy
from functools import partial
from typing import Any

from torch import Tensor, nn

from fdtasil.compute import ask_module
from fdtasil.errors import warn
from fdtasil.experts.expert import Expert

__all__ = ["ask_as_it_is", "open_module"]

_CONTAINERS = (list, tuple, set, frozenset)


def open_module(given: nn.Module) -> Expert:
    """Ask a module by calling a copy of it; the caller's may go on training."""
    return ask_as_it_is(_copied(given))


def ask_as_it_is(module: nn.Module) -> Expert:
    """Ask a module that nobody else has by calling it."""
    answer = partial(ask_module, module.eval())
    return Expert(answer, f"the torch module {type(module).__name__}", module=module)


def _copied(module: nn.Module) -> nn.Module:
    """Return a copy, made part by part where `copy.deepcopy` can't.

    It can copy neither locks nor tensors with a history, such as those of the last forward pass,
    of gSDE and of the old weight_norm.
    """
    try:
        return copy.deepcopy(module)
    except Exception:  # each type that can't be copied has its own
        pass
    try:
        return _by_parts(module, {})
    except Exception:
        warn(
            f"the torch module {type(module).__name__} can't be copied: it is asked as it is, in "
            "evaluation mode; leave it unchanged until the run is over"
        )
        return module


def _by_parts(given: Any, made: dict[int, Any]) -> Any:
    """Return a copy of an object, attribute by attribute.

    Args:
        given: The object.
        made: Copies by the id of their originals, as `copy.deepcopy` keeps them.
    """
    if id(given) in made:
        return made[id(given)]
    twin = made[id(given)] = given.__class__.__new__(given.__class__)
    attributes = dict(vars(given))
    # Weights and layers first: other attributes may be lists of them.
    for name in ("_parameters", "_buffers", "_modules"):
        if isinstance(given, nn.Module):
            twin.__dict__[name] = {k: _part(v, made) for k, v in attributes.pop(name).items()}
    twin.__dict__.update({name: _part(value, made) for name, value in attributes.items()})
    return twin


def _part(given: Any, made: dict[int, Any]) -> Any:
    """Return a copy of an attribute, or the attribute itself where there can't be one."""
    if id(given) in made:
        return made[id(given)]
    if isinstance(given, Tensor):
        plain = given.detach().clone()
        is_weight = isinstance(given, nn.Parameter)
        made[id(given)] = nn.Parameter(plain, given.requires_grad) if is_weight else plain
        return made[id(given)]
    if isinstance(given, nn.Module):
        return _by_parts(given, made)
    try:
        return copy.deepcopy(given, dict(made))  # what fails half-way must not be kept
    except Exception:
        return _piecewise(given, made)


def _piecewise(given: Any, made: dict[int, Any]) -> Any:
    if type(given) in _CONTAINERS:
        return type(given)(_part(one, made) for one in given)
    if isinstance(given, dict):
        return type(given)({key: _part(value, made) for key, value in given.items()})
    if not hasattr(given, "__dict__") or isinstance(given, type):
        return given  # a lock, or what else there is one of
    try:
        return _by_parts(given, made)
    except Exception:
        made.pop(id(given), None)
        return given
