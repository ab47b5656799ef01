"""Imports run one way: a module may import from its own part of the package or from parts of lower layers."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "src" / "occfusion"

# the parts of the package from the ground up; a part is a module or a folder directly under `occfusion`
LAYERS = [
    {"types", "errors"},
    {"cpu", "fields", "gpu"},
    {"files", "geometry", "quality"},
    {"footage", "perceptual", "report", "splat", "synth"},
    {"evaluation", "human"},
    # what a video shows, before any prior is asked
    {"compare", "data", "fitting", "observation"},
    {"importing", "motion", "priors"},
    {"bench", "export", "inpaint", "show"},
    {"settings", "stability"},
    {"stages"},
    {"plan", "prior_training"},
    {"run"},
    {"viewer"},
    {"cli"},
    {"__main__"},
]
LEVEL = {part: level for level, parts in enumerate(LAYERS) for part in parts}

LIGHTNING = {"data/module.py", "stages", "run", "cli"}
# heavy or optional libraries, and the only parts that may import them when they are themselves imported
AT_TOP_LEVEL_ONLY_IN = {
    "lightning": LIGHTNING,
    "hydra": {"cli", "run/app.py"},
    "diffusers": set(),
    "transformers": set(),
    "gsplat": set(),
    "matplotlib": set(),
    "torchvision": set(),
    "stlpips_pytorch": set(),
    "lpips": set(),
    "smplx": set(),
    "anny": set(),
    "viser": set(),
    "trimesh": set(),
    "ai_edge_litert": set(),
}
# libraries that only a few parts may touch at all
ANYWHERE_ONLY_IN = {
    "hydra": {"cli", "run/app.py", "settings/schema.py"},
    "omegaconf": {
        "cli",
        "run/app.py",
        "run/loaded.py",
        "run/folder.py",
        "settings",
        "compare/reading.py",
    },
    "lightning": LIGHTNING | {"settings/schema.py"},
    "stlpips_pytorch": set(),
    "torchvision": set(),
}


def modules() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def imports(path: Path, *, top_level: bool) -> Iterator[tuple[int, str]]:
    """Line and full name of each import; `top_level` leaves out functions and `TYPE_CHECKING` blocks."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in _top_level(tree) if top_level else ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: relative import"
            assert node.module is not None
            yield node.lineno, node.module
            if node.module == "occfusion":
                yield from ((node.lineno, f"occfusion.{alias.name}") for alias in node.names)


def _top_level(node: ast.AST) -> Iterator[ast.AST]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            continue
        if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
            continue
        yield child
        yield from _top_level(child)


def part_of(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def is_within(path: Path, places: set[str]) -> bool:
    inside = path.relative_to(PACKAGE).as_posix()
    return any(inside == place or inside.startswith(f"{place}/") for place in places)


def test_every_part_has_a_layer():
    parts = {part_of(path) for path in modules()} - {"__init__"}
    assert parts - set(LEVEL) == set(), "add new parts to LAYERS"


@pytest.mark.parametrize("path", modules(), ids=lambda path: path.relative_to(PACKAGE).as_posix())
def test_imports_run_downwards(path):
    part = part_of(path)
    for line, name in imports(path, top_level=False):
        words = name.split(".")
        if words[0] != "occfusion" or len(words) == 1:
            continue
        other = words[1]
        if other == part or other == "__version__":
            continue
        assert other in LEVEL, f"{path}:{line} imports {name}, which has no layer"
        assert LEVEL[other] < LEVEL[part], (
            f"{path}:{line} (layer {LEVEL[part]}) imports {name} (layer {LEVEL[other]})"
        )


def test_few_modules_lie_loose_at_the_top():
    loose = {path.stem for path in PACKAGE.glob("*.py")} - {"__init__"}
    assert loose == {"__main__", "errors", "types"}, (
        "a new module belongs into the folder that says what it is"
    )


def test_files_import_nothing_of_ours_but_errors():
    for path in (PACKAGE / "files").glob("*.py"):
        ours = {
            name.split(".")[1] for _, name in imports(path, top_level=False) if name.startswith("occfusion.")
        }
        assert ours <= {"files", "errors"}, path


def test_heavy_libraries_stay_where_they_belong():
    for path in modules():
        for line, name in imports(path, top_level=True):
            places = AT_TOP_LEVEL_ONLY_IN.get(name.split(".")[0])
            assert places is None or is_within(path, places), f"{path}:{line} imports {name} at top level"
        for line, name in imports(path, top_level=False):
            places = ANYWHERE_ONLY_IN.get(name.split(".")[0])
            assert places is None or is_within(path, places), f"{path}:{line} imports {name}"


def test_nothing_is_pickled_or_unpickled_but_by_the_restricted_reader():
    for path in modules():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Attribute) and ast.unparse(node.value) in ("pickle", "joblib", "dill"):
                allowed = node.attr in ("UnpicklingError", "PickleError") or is_within(
                    path, {"files/unpickle.py"}
                )
                assert allowed, f"{path}:{node.lineno} uses {ast.unparse(node)}"
            if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("load"):
                for option in node.keywords:
                    safe = {"allow_pickle": "False", "weights_only": "True"}.get(option.arg or "")
                    assert safe in (None, ast.unparse(option.value)), (
                        f"{path}:{node.lineno}: {ast.unparse(option)}"
                    )


def test_no_module_is_part_of_a_cycle():
    """Within a layer imports are free, so a cycle between modules has to be looked for."""
    graph: dict[str, set[str]] = {}
    for path in modules():
        name = ".".join(("occfusion", *path.relative_to(PACKAGE).with_suffix("").parts)).removesuffix(
            ".__init__"
        )
        graph[name] = {other for _, other in imports(path, top_level=True) if other.startswith("occfusion.")}
    finished: set[str] = set()

    def visit(name: str, trail: tuple[str, ...]) -> None:
        assert name not in trail, " -> ".join((*trail, name))
        if name in finished or name not in graph:
            return
        for other in sorted(graph[name]):
            # a package's __init__ gathers its own modules: their imports of siblings are no cycle
            if other != name and not name.startswith(f"{other}."):
                visit(other, (*trail, name))
        finished.add(name)

    for name in graph:
        visit(name, ())


@pytest.mark.parametrize("verb", ["cli.render", "cli.export", "cli.view", "viewer.page"])
def test_what_shows_an_avatar_waits_for_no_trainer(verb):
    """Lightning takes as long to import as everything else together, and a picture of an avatar needs none of it."""
    found: dict[str, str] = {}  # module -> who imports it first
    due = [(f"occfusion.{verb}", "")]
    while due:
        name, origin = due.pop()
        parts = name.split(".")
        file = PACKAGE.joinpath(*parts[1:])
        path = file / "__init__.py" if file.is_dir() else file.with_suffix(".py")
        if name in found or not path.is_file():
            continue
        found[name] = origin
        due += [(".".join(parts[:k]), name) for k in range(1, len(parts))]
        for line, other in imports(path, top_level=True):
            assert other.split(".")[0] not in ("lightning", "torchmetrics", "kornia"), (
                f"{path}:{line} imports {other}, and {origin} imports {name}"
            )
            due.append((other, name))
    assert "occfusion.errors" in found


def test_a_file_is_no_longer_than_a_person_reads():
    for path in modules():
        lines = len(path.read_text(encoding="utf-8").splitlines())
        assert lines <= 400, f"{path} has {lines} lines"
