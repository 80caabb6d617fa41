"""Plugins: Python files that add to the tables of this package, without a change of it.

A plugin is a file or a module with the function ``register(plugin, **options)``, which calls the
methods of ``Plugin``. ``gamba COMMAND --plugin my.py name=value`` loads it before the command. A
run records its name, the SHA-256 of its text and its options; a saved model does so if it needs it.
A plugin runs with the rights of its user: none is ever loaded because a file asks for it.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import sys
import types
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, NamedTuple

from .errors import UserError, first_line

GROUP = "gamba_warp.plugins"  # of entry points: installed plugins are given by their name


class _Table(NamedTuple):
    """Table of a module, and the conversion of plugins' entries."""

    own: dict[str, Any]
    entry: Callable[[Any], Any]


_TABLES: dict[str, _Table] = {}  # by kind, once their modules are imported
_ADDED: dict[str, dict[str, Any]] = {}  # values of plugins, by kind and name
_LOADED: dict[str, Plugin] = {}


class Plugin:
    """Additions of one plugin.

    Attributes:
        name: stem of its file, or name of its entry point.
        sha256: of its text.
        options: given by the user, ``name=value`` with values in JSON or as text.
        added: kinds and names.
    """

    def __init__(self, name: str, sha256: str, options: Mapping[str, Any]) -> None:
        """Start without additions."""
        self.name, self.sha256, self.options = name, sha256, dict(options)
        self.added: list[tuple[str, str]] = []

    @property
    def record(self) -> dict[str, Any]:
        """JSON-ready name, hash and options."""
        return {"name": self.name, "sha256": self.sha256, "options": self.options}

    def loss_term(self, name: str, value: Callable, weight: float | Callable) -> None:
        """Add a term of the training loss.

        Args:
            name: of the term; the log has ``loss_NAME``.
            value: of ``train.objective.losses.LossInputs`` to ``[B, V+1]``, or ``[B]`` if it has no
                views, unweighted; None if it cannot be computed.
            weight: >= 0, or a function of ``losses.Progress``.
        """
        self._add("loss term", name, (value, weight))

    def image_metric(self, name: str, metric: Any) -> None:
        """Add an ``image_metrics.Metric``: validations, eval-views and tables then have it."""
        self._add("image metric", name, metric)

    def dataset_layout(self, name: str, mark: str, read: Callable) -> None:
        """Add a layout of datasets.

        Args:
            name: for ``open_dataset``.
            mark: file or folder that marks an object's folder.
            read: of that folder to ``data.layouts.ObjectFiles``; raises UserError.
        """
        self._add("dataset layout", name, (mark, read))

    def encoder(self, name: str, build: Callable) -> None:
        """Add an image encoder, for ``--set encoder=NAME``.

        Args:
            name: of the encoder.
            build: of ``GambaConfig`` and ``encoder_weights`` to a network and C. It maps pictures
                ``[B, S, S, 3]`` in [0, 1], S = ``config.encoder_size``, to tokens ``[B, K, C]``.
        """
        self._add("encoder", name, build)

    def decoder(self, name: str, build: Callable) -> None:
        """Add a decoder, for ``--set decoder=NAME``.

        Args:
            name: of the decoder.
            build: of ``GambaConfig`` to a module that maps tokens ``[B, L, config.width]`` to
                ``Gaussians`` ``[B, N]``.
        """
        self._add("decoder", name, build)

    def sampler(self, name: str, order: Callable) -> None:
        """Add an order of the training objects, for ``--sampler NAME``.

        Args:
            name: of the sampler.
            order: of a ``numpy.random.Generator`` of seed and epoch and the list of uids to the
                positions in it that an epoch takes, in order; as many as there are uids.
        """
        self._add("sampler", name, order)

    def scheduler(self, name: str, share: Callable[[float], float]) -> None:
        """Add a schedule of the learning rate, for ``--schedule NAME``.

        Args:
            name: of the schedule.
            share: of the part of the run after the warm-up, 0 to 1, to the rate as a share of --lr.
        """
        self._add("scheduler", name, share)

    def _add(self, kind: str, name: str, value: Any) -> None:
        if not isinstance(name, str) or not name.replace("_", "").isalnum():
            raise UserError(f"the {kind} {str(name)[:60]!r} is not a name of letters and digits")
        table = _TABLES.get(kind)
        if name in _ADDED.get(kind, {}) or (table is not None and name in table.own):
            raise UserError(f"there is already a {kind} '{name}'")
        if table is not None:
            table.own[name] = table.entry(value)
        _ADDED.setdefault(kind, {})[name] = value
        self.added.append((kind, name))

    def remove(self) -> None:
        """Remove the additions from their tables."""
        for kind, name in self.added:
            _ADDED[kind].pop(name, None)
            if kind in _TABLES:
                _TABLES[kind].own.pop(name, None)
        self.added.clear()
        _LOADED.pop(self.name, None)


def extensible(
    kind: str, own: dict[str, Any], entry: Callable[[Any], Any] = lambda value: value
) -> dict[str, Any]:
    """Let plugins add to a module's table.

    Args:
        kind: name of the kind of its entries.
        own: the table.
        entry: conversion of an addition to an entry.

    Returns:
        The table.

    Raises:
        UserError: a plugin has added a name of the table before.
    """
    for name, value in _ADDED.get(kind, {}).items():
        if name in own:
            raise UserError(f"--plugin: there is already a {kind} '{name}'")
        own[name] = entry(value)
    _TABLES[kind] = _Table(own, entry)
    return own


def added(kind: str) -> dict[str, Any]:
    """Return the additions of all plugins of one kind, by name."""
    return _ADDED.get(kind, {})


def load(words: Sequence[str]) -> list[dict[str, Any]]:
    """Load plugins, unless they are loaded already with the same text and options.

    Args:
        words: for each plugin its file (.py) or the name of its entry point, then its options as
            NAME=VALUE.

    Returns:
        As ``records``.

    Raises:
        UserError: a plugin is missing, fails, has a name that is taken, or is loaded with other
            text or options.
    """
    for source, options in _chosen(words):
        _load(source, options)
    return records(words)


def records(words: Sequence[str]) -> list[dict[str, Any]]:
    """Return the ``Plugin.record`` of each loaded plugin; ``words`` as for ``load``."""
    return [_LOADED[_name_of(source)].record for source, _ in _chosen(words)]


def _name_of(source: str) -> str:
    return Path(source).stem if source.endswith(".py") else source


def _chosen(words: Sequence[str]) -> list[tuple[str, dict[str, Any]]]:
    """Sources and options of plugins."""
    chosen: list[tuple[str, dict[str, Any]]] = []
    for word in words:
        name, equals, text = word.partition("=")
        if equals and name.isidentifier():
            if not chosen:
                raise UserError(f"--plugin {word}: an option before any plugin")
            chosen[-1][1][name] = _value(text)
        else:
            chosen.append((word, {}))
    return chosen


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text


def _load(source: str, options: dict[str, Any]) -> None:
    try:
        name, path, entry = _name_of(source), Path(source), None
        if not source.endswith(".py"):
            entry = next((e for e in entry_points(group=GROUP) if e.name == source), None)
            spec = entry and importlib.util.find_spec(entry.module)
            if not spec or not spec.origin:
                raise UserError("neither a .py file nor an installed plugin")
            path = Path(spec.origin)
        text = path.read_bytes()
        digest = hashlib.sha256(text).hexdigest()
        known = _LOADED.get(name)
        if known is not None:
            if (known.sha256, known.options) != (digest, options):
                raise UserError("already loaded with another text or other options")
            return
        plugin = Plugin(name, digest, options)
        try:
            if entry is not None:
                register = getattr(entry.load(), "register", None)
            else:
                module = types.ModuleType(f"gamba_plugin_{name}")
                module.__file__ = str(path)
                sys.modules[module.__name__] = module  # where dataclasses look types up
                exec(compile(text, str(path), "exec"), vars(module))
                register = getattr(module, "register", None)
            if not callable(register):
                raise UserError("has no function register(plugin, **options)")
            register(plugin, **options)
        except BaseException:
            plugin.remove()
            raise
    except UserError as error:
        raise UserError(f"--plugin {source}: {error}") from error
    except Exception as error:  # of the plugin, any kind
        raise UserError(
            f"--plugin {source}: {type(error).__name__}: {first_line(error)}"
        ) from error
    _LOADED[name] = plugin


def unload() -> None:
    """Remove the additions of all plugins."""
    for plugin in [*_LOADED.values()]:
        plugin.remove()


def needed(**names: str) -> list[dict[str, Any]]:
    """Return the records of the plugins that have added these names.

    Args:
        names: by kind, such as ``decoder="mine"``.
    """
    pairs = {*names.items()}
    return [p.record for p in _LOADED.values() if pairs & {*p.added}]


def missing(record: Mapping[str, Any]) -> str | None:
    """Return a message if the plugin of a record is not loaded, else None."""
    name, digest = str(record["name"])[:100], str(record["sha256"])[:12]
    if name in _LOADED:
        return None
    return f"needs the plugin '{name}' (SHA-256 {digest}…): give --plugin {name}.py"


def differs(record: Mapping[str, Any]) -> bool:
    """True if the loaded plugin of a record's name has another text or other options."""
    return _LOADED[str(record["name"])].record != dict(record)
