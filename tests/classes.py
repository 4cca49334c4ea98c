"""The classes of the registered plugins: ``from classes import Fobg, Pushing``, wherever their files lie."""

from bench.model import registry


def __getattr__(name):
    found = [entry.plugin for table in registry.entries().values() for entry in table.values()]
    found = [plugin for plugin in found if getattr(plugin, "__name__", "") == name]
    if len(found) != 1:
        raise AttributeError(f"{len(found)} plugins have a class {name}")
    return found[0]
