"""A layer imports only from its left: errors ← core ← io ← parallel ← steps ← cli."""

import ast
from pathlib import Path

import pytest

import shadowtool

PACKAGE = Path(shadowtool.__file__).parent
LAYERS = ("choices", "errors", "core", "io", "parallel", "steps", "cli")
MODULES = sorted(PACKAGE.rglob("*.py"))
# What only these places may open; threads are started in the last alone.
ONLY_IN = {
    "OpenEXR": {"io/image.py", "io/openexr_core.py"},
    "ctypes": {"io/openexr_core.py", "cli/process.py"},
    "threading": {"io/files.py", "io/image.py"},
    "concurrent": {"parallel.py"},
}
NOT_IN_CORE = {"pathlib", "click", "tqdm", "os", "io", "logging", "av", "fileseq", "OpenEXR"}


def imports(module: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(module.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: relative import"
            found.add(node.module or "")
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def layer(name: str) -> int | None:
    parts = name.split(".")
    return LAYERS.index(parts[1]) if parts[0] == "shadowtool" and parts[1:] else None


@pytest.mark.parametrize("module", MODULES, ids=lambda m: str(m.relative_to(PACKAGE)))
def test_imports_go_to_the_left(module: Path) -> None:
    relative = module.relative_to(PACKAGE)
    if relative.name == "__init__.py" and len(relative.parts) == 1:
        return
    own = LAYERS.index(relative.parts[0].removesuffix(".py"))
    for name in imports(module):
        if name == "shadowtool.__version__":
            continue
        other = layer(name)
        assert other is None or other <= own, f"{relative} imports {name}"


@pytest.mark.parametrize("library, places", ONLY_IN.items())
def test_what_one_module_is_for_no_other_does(library: str, places: set[str]) -> None:
    users = {
        str(module.relative_to(PACKAGE))
        for module in MODULES
        if any(name.split(".")[0] == library for name in imports(module))
    }
    assert users == places


def test_what_is_raised_on_purpose_stands_in_one_place() -> None:
    for module in MODULES:
        classes = [
            n for n in ast.walk(ast.parse(module.read_text())) if isinstance(n, ast.ClassDef)
        ]
        raised = [c.name for c in classes if any("Error" in ast.unparse(b) for b in c.bases)]
        assert not raised or module.name == "errors.py", module.name


def test_core_knows_neither_files_nor_terminals() -> None:
    for module in (PACKAGE / "core").glob("*.py"):
        used = {name.split(".")[0] for name in imports(module)}
        assert not used & NOT_IN_CORE, module.name
