"""Who may import whom, how long things may be, and what they may be called: read off the code's syntax trees."""

import ast
import importlib
import inspect
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import stmc
from stmc.cli.dispatch import COMMANDS

ROOT = Path(stmc.__file__).parent
REPOSITORY = ROOT.parent
SHIPPED = ROOT / "assets"
"""Files that users take away, such as an add-on in one file, and that the library never imports."""
TREES = {path: ast.parse(path.read_text("utf-8")) for path in sorted(ROOT.rglob("*.py")) if SHIPPED not in path.parents}

CORE = [
    {"io"},
    {"diffusion", "motion", "settings"},
    {"denoisers", "text", "timeline"},
    {"composing", "evaluators", "formats"},
    {"editing"},
    {"model"},
    {"run"},
]
"""A room of the core imports those before it only, or itself."""

WINGS = [{"data"}, {"training"}, {"viewing"}, {"evaluation"}, {"cli"}, {"__main__"}]
"""Wings import the core and the wings before them; the core imports no wing."""

TIERS = CORE + WINGS

FORBIDDEN = {
    "stmc.timeline": {"torch", "stmc.diffusion"},
    "stmc.diffusion": {"stmc.timeline", "stmc.motion"},
    "stmc.denoisers": {"stmc.timeline", "stmc.motion"},
    "stmc.evaluators": {"stmc.composing", "stmc.timeline"},
    "stmc.formats": {"stmc.denoisers", "stmc.composing"},
    "stmc.editing.constraints": {"stmc.denoisers", "stmc.composing"},
    "stmc.evaluation.metrics": {"stmc.denoisers", "stmc.composing", "stmc.evaluators"},
    "stmc.evaluation.benchmarks": {"stmc.evaluators", "stmc.model"},
    "stmc.evaluation.results": {"stmc.evaluation.metrics", "stmc.model"},
}
"""Packages and modules that a package must not even import through others."""

ROOMS, ARROWS, NAMES = 22, 110, 18
"""At most so many rooms and arrows between them, and names at the top beside `__main__`."""


def home(path: Path) -> str:
    """The module or package right below `stmc` that a file belongs to."""
    return path.relative_to(ROOT).parts[0].removesuffix(".py")


def imports(tree: ast.AST) -> set[str]:
    """Everything imported anywhere in it: `stmc`'s own by their homes, others by their first names."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            names |= {f"stmc.{alias.name}" for alias in node.names} if node.module == "stmc" else {node.module}
    return {name.split(".")[1] if name.startswith("stmc.") else name.split(".")[0] for name in names}


MODULES = {path: tree for path, tree in TREES.items() if path != ROOT / "__init__.py"}
PUBLIC = [name for name in stmc.__all__ if not inspect.ismodule(getattr(stmc, name))]
DIRECT: dict[str, set[str]] = {}
for _path, _tree in MODULES.items():
    DIRECT.setdefault(home(_path), set()).update(imports(_tree))


def functions(path: Path) -> list[tuple[str, int]]:
    """Every function of a file and its lines, methods and nested ones too."""
    kinds = (ast.FunctionDef, ast.AsyncFunctionDef)
    tree = ast.parse(path.read_text("utf-8"))
    return [
        (f"{path.name}:{node.name}", node.end_lineno - node.lineno + 1)
        for node in ast.walk(tree)
        if isinstance(node, kinds)
    ]


def test_every_module_has_a_tier():
    assert set(DIRECT) == set().union(*TIERS)


@pytest.mark.parametrize("module", sorted(DIRECT))
def test_a_module_imports_lower_tiers_only(module):
    tier = next(number for number, tier in enumerate(TIERS) if module in tier)
    lower = set().union(*TIERS[:tier])
    own = set(DIRECT) & DIRECT[module]
    assert own - lower - {module} == set()


@pytest.mark.parametrize("package", sorted(FORBIDDEN))
def test_a_package_does_not_reach_what_it_must_not(package):
    modules = [name for name in FILES if f"{name}.".startswith(f"{package}.")]
    assert modules
    found = reached(modules)
    assert [name for name in FORBIDDEN[package] if any(f"{each}.".startswith(f"{name}.") for each in found)] == []


def test_the_house_has_few_rooms_and_few_arrows():
    rooms = set(DIRECT) - {"__main__"}
    arrows = [(room, other) for room in rooms for other in DIRECT[room] & rooms - {room}]
    assert len(rooms) <= min(ROOMS, NAMES) and len(arrows) <= ARROWS


def test_every_file_has_a_name_of_its_own():
    names = [path.name for path in MODULES if path.name not in ("__init__.py", "__main__.py")]
    assert sorted(names) == sorted(set(names))


def test_hydra_is_seen_by_commands_alone():
    for module, imported in DIRECT.items():
        assert module == "cli" or not {"hydra", "omegaconf"} & imported, module


def test_planning_a_timeline_does_not_import_torch():
    code = "import sys, stmc.timeline.planning; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_no_module_is_a_drawer_for_everything_and_none_is_called_like_a_public_function():
    modules = {
        path.parent.name if path.name == "__init__.py" else path.stem for path in MODULES if path.stem not in COMMANDS
    }
    assert not modules & {"utils", "util", "tools", "common", "misc", "helpers"}
    public = {
        node.name
        for path, tree in MODULES.items()
        for node in tree.body
        if home(path) != "cli" and isinstance(node, ast.FunctionDef) and not node.name.startswith("_")
    }
    assert not modules & public


def test_every_name_of_the_package_is_what_it_says_also_once_all_modules_are_imported():
    for module in DIRECT:
        importlib.import_module(f"stmc.{module}")
    for name in PUBLIC:
        value = getattr(stmc, name)
        assert inspect.isclass(value) or inspect.isfunction(value), name
        assert value.__module__.startswith("stmc."), name


def test_sizes_stay_within_the_yardstick():
    """No file over 400 lines, no function over 80, 95 of 100 functions within 40."""
    files = [*TREES, *(REPOSITORY / "scripts").glob("*.py")]
    assert {path.name: lines for path in files if (lines := len(path.read_text("utf-8").splitlines())) > 400} == {}
    found = [each for path in files for each in functions(path)]
    assert [each for each in found if each[1] > 80] == []
    longer = [each for each in found if each[1] > 40]
    assert len(longer) <= 0.05 * len(found), longer


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_library_module_says_what_it_is_and_prints_nothing(path):
    assert ast.get_docstring(TREES[path]) or not TREES[path].body, "a module docstring"
    for node in ast.walk(TREES[path]):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and home(path) != "cli":
            assert node.func.id not in ("print", "breakpoint", "eval", "exec"), f"line {node.lineno}"
        assert not isinstance(node, ast.Global), f"line {node.lineno}: global"
        if isinstance(node, ast.ExceptHandler):
            assert node.type is not None, f"line {node.lineno}: a bare except"


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_everything_public_says_what_it_does(path):
    """Functions, classes and methods without an underscore, but for what a protocol or PyTorch has said already."""
    for node in TREES[path].body:
        if not isinstance(node, (ast.FunctionDef, ast.ClassDef)) or node.name.startswith("_"):
            continue
        if home(path) == "cli" and node.name == "main":
            continue  # the module's docstring is the command's help
        assert ast.get_docstring(node), f"{node.name}, line {node.lineno}"
        for method in node.body if isinstance(node, ast.ClassDef) else []:
            if isinstance(method, ast.FunctionDef) and not method.name.startswith("_") and method.name != "forward":
                assert ast.get_docstring(method) or _is_protocol(node), f"{node.name}.{method.name}"


def _is_protocol(node: ast.ClassDef) -> bool:
    return any(isinstance(base, ast.Name) and base.id == "Protocol" for base in node.bases)


def test_import_stmc_alone_gives_every_public_name_and_package():
    code = "import stmc; stmc.timeline.Timeline, stmc.evaluation.metrics.fid, stmc.motion.body.JOINTS"
    subprocess.run([sys.executable, "-c", code], check=True)
    assert set(dir(stmc)) == set(stmc.__all__) == {*PUBLIC, *(set(DIRECT) - {"__main__"})}


def dotted(path: Path) -> str:
    return ".".join(path.relative_to(REPOSITORY).with_suffix("").parts).removesuffix(".__init__")


FILES = {dotted(path): tree for path, tree in TREES.items()}


def loaded(tree: ast.Module) -> set[str]:
    """What importing a file imports: not what its functions import once they are called."""
    names, left = set(), list(tree.body)
    while left:
        match left.pop():
            case ast.Import(names=aliases):
                names |= {alias.name for alias in aliases}
            case ast.ImportFrom(module=module, names=aliases):
                names |= {module, *(f"{module}.{alias.name}" for alias in aliases)}
            case ast.If() | ast.Try() | ast.With() as block:
                left += [node for node in ast.walk(block) if isinstance(node, (ast.Import, ast.ImportFrom))]
    return names


def reached(modules: list[str]) -> set[str]:
    """Everything that importing these modules imports, directly or through others."""
    found, left = set(), set(modules)
    while left:
        name = left.pop()
        parents = {name.rpartition(".")[0]} - {"", "stmc"}
        found.add(name)
        left |= (parents | (loaded(FILES[name]) if name in FILES else set())) - found
    return found


def test_no_modules_import_each_other_in_a_circle_not_even_within_functions():
    """Packages whose `__init__` is named are left out where one of their modules is meant."""
    graph = {}
    for name, tree in FILES.items():
        whole = ast.Module([node for node in ast.walk(tree) if isinstance(node, (ast.Import, ast.ImportFrom))], [])
        named = loaded(whole) & FILES.keys() - {name}
        graph[name] = {each for each in named if not any(other.startswith(f"{each}.") for other in named)}
    assert len(list(TopologicalSorter(graph).static_order())) == len(FILES)


ONLY_TRAINING = {"accelerate", "tensorboard", "smplx"}


def test_sampling_reaches_nothing_that_only_training_installs():
    """Neither the commands that sample nor the packages behind them import accelerate or tensorboard."""
    found = reached(["stmc.cli.sample", "stmc.cli.evaluate", "stmc.evaluation.benchmarks", "stmc.run"])
    assert "stmc.composing.running" in found
    assert not {part for name in found for part in name.split(".")} & ONLY_TRAINING


@pytest.mark.slow
def test_sampling_needs_nothing_that_only_training_installs():
    """Neither the commands that sample nor the packages behind them import accelerate or tensorboard."""
    code = (
        "import sys\n"
        "sys.modules |= dict.fromkeys(('accelerate', 'tensorboard', 'smplx'))\n"
        "import stmc.cli.sample, stmc.cli.evaluate, stmc\n"
        "stmc.load, stmc.load_evaluator, stmc.evaluation.benchmarks"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=REPOSITORY)
