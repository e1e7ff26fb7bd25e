"""The size of the house: lines, public names, long argument lists, import circles, and the length of the control step.

    .venv/bin/python -m benchmarks.size

*Lines* are all lines of ``gpmpc/**/*.py``. A *public name* is a function or class at the top level of a module, without
an underscore at the beginning of its name or of a module's above it; constants are counted apart, and so are names that
packages export from private modules. *Arguments* are those
of functions and methods, ``self`` and ``cls`` apart. A *circle* is a set of modules, or of rooms, that import each
other, wherever the import statement stands. ``tests/test_architecture.py`` holds the limits.
"""

import ast
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "gpmpc"


def main() -> None:
    """Counts and prints."""
    house = House(ROOT)
    print(f"lines of {PACKAGE}/: {house.lines}, files of mpc/: {house.mpc_files}")
    print(
        f"public names: {len(house.public_names)}, and constants: {len(house.public_constants)}"
    )
    print(
        f"names that packages export from private modules: {len(house.exported_names)}"
    )
    print(f"\n{'room':16}{'lines':>8}{'files':>8}{'names':>8}{'constants':>11}")
    names, constants = (
        Counter(map(_room, found))
        for found in (house.public_names, house.public_constants)
    )
    for room, modules in sorted(
        house.rooms.items(), key=lambda item: -house.lines_of(item[1])
    ):
        print(
            f"{room:16}{house.lines_of(modules):8}{len(modules):8}{names[room]:8}{constants[room]:11}"
        )
    for most in (10, 8):
        found = house.functions_above(most)
        print(f"\nfunctions with more than {most} arguments: {len(found)}")
        if most == 10:
            print(
                "\n".join(
                    f"  {count:3}  {name}"
                    for name, count in sorted(found.items(), key=lambda item: -item[1])
                )
            )
    for kind, circles in (
        ("rooms", house.room_circles),
        ("modules", house.module_circles),
    ):
        print(f"\ncircles of {kind}: {len(circles)}")
        for circle in circles:
            print(f"  {', '.join(circle)}")
    print("\nlines of the control steps in mpc/:")
    for name, lines in house.control_steps.items():
        print(f"  {lines:4}  {name}")


@dataclass(frozen=True)
class House:
    """The source of the package.

    Attributes:
        root: Folder that holds it.
    """

    root: Path

    @cached_property
    def sources(self) -> dict[str, str]:
        """Text of every module by its dotted name."""
        found = {}
        for path in sorted((self.root / PACKAGE).rglob("*.py")):
            parts = path.relative_to(self.root).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = (
                path.read_text()
            )
        return found

    @cached_property
    def trees(self) -> dict[str, ast.Module]:
        """Syntax tree of every module."""
        return {name: ast.parse(text) for name, text in self.sources.items()}

    @property
    def lines(self) -> int:
        """All lines."""
        return self.lines_of(list(self.sources))

    def lines_of(self, modules: list[str]) -> int:
        """Lines of some modules."""
        return sum(len(self.sources[name].splitlines()) for name in modules)

    @cached_property
    def rooms(self) -> dict[str, list[str]]:
        """Modules of every room: what stands directly in the package, folder or file."""
        found: dict[str, list[str]] = {}
        for name in self.sources:
            found.setdefault(_room(name), []).append(name)
        return found

    @property
    def mpc_files(self) -> int:
        """Files of the room ``mpc``."""
        return len(self.rooms["mpc"])

    @cached_property
    def public_names(self) -> list[str]:
        """Dotted names of the functions and classes that users may import."""
        return self._public(_functions_and_classes)

    @cached_property
    def public_constants(self) -> list[str]:
        """Dotted names of the constants that users may import."""
        return self._public(_constants)

    def _public(self, names: Callable[[list[ast.stmt]], Iterator[str]]) -> list[str]:
        return [
            f"{module}.{name}"
            for module, tree in self.trees.items()
            for name in dict.fromkeys(names(tree.body))
            if not _is_private(f"{module}.{name}")
        ]

    @cached_property
    def exported_names(self) -> list[str]:
        """Dotted names of the functions and classes of private modules that public ones export by ``__all__``."""
        found = []
        for module, tree in self.trees.items():
            if not _is_private(module):
                exported = {
                    node.value
                    for part in tree.body
                    if _assigns_all(part)
                    for node in _strings(part)
                }
                for part in _import_statements(tree.body):
                    source = (
                        self.trees.get(part.module or "")
                        if _is_private(part.module or "")
                        else None
                    )
                    defined = (
                        {*_functions_and_classes(source.body)} if source else set()
                    )
                    found += [
                        f"{module}.{alias.name}"
                        for alias in part.names
                        if alias.name in defined & exported
                    ]
        return found

    @cached_property
    def arguments(self) -> dict[str, int]:
        """Number of arguments of every function and method."""
        found = {}
        for module, tree in self.trees.items():
            for function in ast.walk(tree):
                if isinstance(function, ast.FunctionDef):
                    given = function.args
                    names = [
                        a.arg
                        for a in (*given.posonlyargs, *given.args, *given.kwonlyargs)
                    ]
                    count = (
                        len([n for n in names if n not in ("self", "cls")])
                        + bool(given.vararg)
                        + bool(given.kwarg)
                    )
                    found[f"{module}.{function.name}:{function.lineno}"] = count
        return found

    def functions_above(self, most: int) -> dict[str, int]:
        """Functions that take more arguments than that."""
        return {name: count for name, count in self.arguments.items() if count > most}

    @cached_property
    def imports(self) -> dict[str, set[str]]:
        """Modules of the package that every module imports."""
        found: dict[str, set[str]] = {}
        for module, tree in self.trees.items():
            found[module] = {
                name for name in _imported(tree, self.sources) if name != module
            }
        return found

    @property
    def module_circles(self) -> list[list[str]]:
        """Modules that import each other."""
        return _circles(self.imports)

    @property
    def room_circles(self) -> list[list[str]]:
        """Rooms that import each other."""
        graph: dict[str, set[str]] = {room: set() for room in self.rooms}
        for module, imported in self.imports.items():
            graph[_room(module)] |= {
                _room(name) for name in imported if name != PACKAGE
            } - {_room(module)}
        return _circles(graph)

    @property
    def control_steps(self) -> dict[str, int]:
        """Lines of every method ``control`` of the room ``mpc``, by class."""
        return {
            f"{module}.{item.name}.control": method.end_lineno - method.lineno + 1
            for module in self.rooms["mpc"]
            for item in self.trees[module].body
            if isinstance(item, ast.ClassDef)
            for method in item.body
            if isinstance(method, ast.FunctionDef) and method.name == "control"
        }


def _room(module: str) -> str:
    return module.split(".")[1] if "." in module else PACKAGE


def _is_private(name: str) -> bool:
    return any(part.startswith("_") for part in name.split("."))


def _assigns_all(part: ast.stmt) -> bool:
    return isinstance(part, ast.Assign) and any(
        isinstance(t, ast.Name) and t.id == "__all__" for t in part.targets
    )


def _strings(part: ast.stmt) -> Iterator[ast.Constant]:
    return (
        node
        for node in ast.walk(part)
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    )


def _import_statements(body: list[ast.stmt]) -> Iterator[ast.ImportFrom]:
    for part in body:
        if isinstance(part, ast.ImportFrom):
            yield part
        elif isinstance(
            part, ast.If
        ):  # for type checkers alone: what a package loads at its first use
            yield from _import_statements(part.body)


def _functions_and_classes(body: list[ast.stmt]) -> Iterator[str]:
    for item in body:
        if isinstance(item, ast.FunctionDef | ast.ClassDef):
            yield item.name
        elif isinstance(item, ast.If | ast.Try):
            yield from _functions_and_classes(item.body + item.orelse)


def _constants(body: list[ast.stmt]) -> Iterator[str]:
    for item in body:
        if isinstance(item, ast.Assign | ast.AnnAssign):
            for target in (
                item.targets if isinstance(item, ast.Assign) else [item.target]
            ):
                yield from (
                    node.id for node in ast.walk(target) if isinstance(node, ast.Name)
                )


def _imported(tree: ast.Module, known: Mapping[str, object]) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in known)
        elif isinstance(node, ast.ImportFrom) and node.module in known:
            for alias in node.names:
                inside = f"{node.module}.{alias.name}"
                yield inside if inside in known else node.module


def _circles(graph: Mapping[str, set[str]]) -> list[list[str]]:
    """Strongly connected sets of more than one node: all that reach each other."""
    reached = {node: _reach(graph, node) for node in graph}
    found = []
    seen = set()
    for node in graph:
        circle = sorted(other for other in reached[node] if node in reached[other])
        if node not in seen and len(circle) > 1:
            found.append(circle)
            seen.update(circle)
    return found


def _reach(graph: Mapping[str, set[str]], start: str) -> set[str]:
    reached = set()
    waiting = [start]
    while waiting:
        for node in graph[waiting.pop()]:
            if node not in reached:
                reached.add(node)
                waiting.append(node)
    return reached


if __name__ == "__main__":
    main()
