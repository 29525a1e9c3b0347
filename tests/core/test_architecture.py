"""Promises of the layout that no linter checks: one version, no stray package, nothing imported too early."""

import ast
import functools
import gc
import re
import tomllib
from pathlib import Path
from types import UnionType

import pytest

import mphdrr
from mphdrr.core.version import VERSION

from .conftest import run_python

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("addon", "core", "operators", "panels")
SOURCES = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]


def toml(name: str) -> dict:
    return tomllib.loads((ROOT / name).read_text(encoding="utf-8"))


def test_version_is_the_same_everywhere():
    texts = {
        name: (ROOT / name).read_text(encoding="utf-8") for name in ("CITATION.cff", "CHANGELOG.md", "docs/conf.py")
    }
    assert toml("pyproject.toml")["tool"]["setuptools"]["dynamic"]["version"] == {"attr": "mphdrr.core.version.VERSION"}
    assert toml("blender_manifest.toml")["version"] == VERSION == mphdrr.__version__
    assert f"\nversion: {VERSION}\n" in texts["CITATION.cff"] and "release = VERSION" in texts["docs/conf.py"]
    assert re.findall(r"^## \[?([0-9.]+)", texts["CHANGELOG.md"], re.MULTILINE)[0] == VERSION


def test_one_compiler_builds_the_kernels_everywhere():
    project = toml("pyproject.toml")
    required = [*project["build-system"]["requires"], *project["project"]["optional-dependencies"]["dev"]]
    assert len({text.split(";")[0].strip() for text in required if text.startswith("ziglang")}) == 1


def test_pyproject_lists_every_package():
    folders = {path.parent for path in SOURCES}
    names = {"mphdrr"} | {".".join(("mphdrr", *folder.relative_to(ROOT).parts)) for folder in folders}
    assert set(toml("pyproject.toml")["tool"]["setuptools"]["packages"]) == names
    assert all((folder / "__init__.py").is_file() for folder in folders)


def test_only_compat_looks_at_the_version_of_blender():
    looks = [path for path in SOURCES if "bpy.app.version" in path.read_text(encoding="utf-8")]
    assert [path.relative_to(ROOT).as_posix() for path in looks] in ([], ["addon/blender/compat.py"])


def test_no_modules_import_each_other_in_a_circle():
    """Count imports in functions and those for type checkers, too: a reader follows them."""
    imports = {module_of(path): imported_modules(path) for path in SOURCES}
    imports = {module: names & set(imports) for module, names in imports.items()}
    while leaves := [module for module, names in imports.items() if not names & set(imports)]:
        for module in leaves:
            del imports[module]
    circles = {module: sorted(names & set(imports)) for module, names in imports.items()}
    assert circles == {}, "what is in a circle, or imports something that is"


BY_NAME = {
    "core/cli/__init__.py": "the modules of commands, among them those that addon.cli gives",
    "addon/registration.py": "all operators and panels, found without a list",
    "core/lazy.py": "the present modules of deprecated paths",
}


def test_modules_are_loaded_by_name_only_from_their_own_folder():
    """Find imports by name, which the tests of circles and rooms do not see.

    Their modules must lie in the same folder, or in another package.
    """
    hidden = []
    for path in SOURCES:
        for call in nodes_of(path):
            if ast.unparse(getattr(call, "func", call)).split(".")[-1] in ("import_module", "__import__"):
                name = call.args[0].values[0] if isinstance(call.args[0], ast.JoinedStr) else call.args[0]
                text = getattr(name, "value", "") if isinstance(name, ast.Constant) else ""
                is_shown = re.match(r"\.(?!\.)|(?!mphdrr\b)\w", text)
                hidden += [] if is_shown else [path.relative_to(ROOT).as_posix()]
    assert set(hidden) == set(BY_NAME)


# Files of core itself that join rooms; all others import none.
JOINING = {"__init__.py", "diffdrr.py", "method_files.py", "scanner_kinds.py"}


def rooms_of_core() -> dict[str, set[str]]:
    """Return the rooms that each room, or subpackage, may import, by the table of docs/structure.md."""
    page = (ROOT / "docs" / "structure.md").read_text(encoding="utf-8")
    table = page.split("| room | holds | may import |\n|---|---|---|\n")[1].split("\n\n")[0]
    allowed: dict[str, set[str]] = {}
    for line in table.splitlines():
        room, rule = (cell.strip() for cell in line.strip("| ").replace(" | ", "|").split("|")[::2])
        rule, _, more = rule.partition(" (")
        above = {name for name in allowed if "." not in name}
        names = set(re.findall(r"\w+", rule)) & above
        is_all = rule.startswith("all above")
        room = room.strip("`")
        allowed[room] = above - names if is_all else names
        if more:  # "`checks` also physics"
            part, _, others = more.rstrip(")").partition(" also ")
            allowed[f"{room}.{part.strip('`')}"] = allowed[room] | set(re.findall(r"\w+", others))
    return allowed


def test_rooms_of_core_import_only_those_that_the_page_allows():
    """Count imports in functions and those for type checkers, too."""
    allowed = rooms_of_core()
    assert {path.parent.name for path in (ROOT / "core").glob("*/__init__.py")} == {r for r in allowed if "." not in r}
    wrong = []
    for path in sorted((ROOT / "core").rglob("*.py")):
        *folders, file = path.relative_to(ROOT / "core").parts
        of_part = allowed.get(".".join(folders[:2]), set())
        rooms = {module.split(".")[1] for module in imported_modules(path) if module.startswith("core.")}
        rooms &= {room for room in allowed if "." not in room}
        if folders:
            rooms -= {folders[0], *allowed[folders[0]], *of_part}
        elif file in JOINING:
            continue
        wrong += [f"{path.relative_to(ROOT).as_posix()} imports {room}" for room in sorted(rooms)]
    assert wrong == []


@functools.cache
def nodes_of(path: Path, kinds: UnionType = ast.Import | ast.ImportFrom | ast.Call) -> list[ast.AST]:
    """Return the nodes of a file that are of these kinds."""
    gc.disable()  # it would look through all trees again and again
    try:
        return [node for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, kinds)]
    finally:
        gc.enable()


def module_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_of(path) for path in SOURCES}


def imported_modules(path: Path) -> set[str]:
    """Return the modules whose names a file imports; a package counts only where names of its own are taken."""
    package = path.relative_to(ROOT).parent.parts
    found = set()
    for node in nodes_of(path):
        if isinstance(node, ast.ImportFrom) and node.level:
            base = package[: len(package) - node.level + 1]
            module = ".".join((*base, node.module) if node.module else base)
            for alias in node.names:
                found.add(f"{module}.{alias.name}" if f"{module}.{alias.name}" in MODULES else module)
    return found - {module_of(path)}


DEFINING = ast.Module | ast.ClassDef | ast.FunctionDef
LEANING = re.compile(r"(What|Where|How|Which|Whose|Of|By|With|In|As|Those|Its|Their|That|One|So|The same)\b")
VERB = re.compile(
    r"""(?x)(Act|Add|Allocate|Append|Apply|Arrange|Ask|Back-project|Begin|Blend|Bring|Build|Calibrate|Call|
    Cancel|Change|Check|Choose|Clip|Collate|Combine|Compare|Complete|Compute|Consume|Convert|Convolve|
    Copy|Count|Create|Crop|Cross|Cut|Declare|Delay|Delete|Determine|Divide|Do|Draw|Empty|End|Enter|
    Estimate|Exit|Extend|Fill|Filter|Find|Finish|Fit|Flush|Force|Forget|Gather|Give|Group|Have|
    Hide|Hold|Import|Integrate|Interpolate|Issue|Judge|Keep|Launch|Lay|Link|List|Load|Log|Look|
    Make|Mark|Measure|Move|Multiply|Narrow|Note|Open|Pack|Paint|Parse|Pick|Place|Predict|Prepare|
    Press|Print|Project|Propose|Put|Queue|Raise|Read|Rebuild|Recolour|Reconstruct|Record|Refuse|
    Register|Relink|Remove|Render|Renumber|Repair|Replace|Report|Require|Resample|Reset|Reshape|
    Restore|Return|Round|Run|Save|Scale|Schedule|Score|Select|Set|Share|Show|Silence|Solve|Sort|
    Split|Start|Stop|Store|Switch|Take|Train|Transform|Tune|Turn|Type|Undo|Update|Voxelize|Wait|
    Warn|Write|Yield)\b"""
)


def test_docstrings_of_functions_begin_with_a_verb_and_none_leans_on_another_text():
    """Check the words, of which D401 of ruff only knows the forms of some: add a missing verb to `VERB`."""
    wrong = []
    for path in SOURCES:
        for node in nodes_of(path, DEFINING):
            decorators = [ast.unparse(decorator) for decorator in getattr(node, "decorator_list", ())]
            is_function = isinstance(node, ast.FunctionDef) and not any("property" in name for name in decorators)
            for place, line in enumerate(node.body):  # the docstring, then those of attributes
                text = getattr(getattr(line, "value", None), "value", None)
                if isinstance(line, ast.Expr) and isinstance(text, str):
                    is_right = VERB.match(text) or place > 0 or not is_function
                    if LEANING.match(text) or not is_right:
                        wrong.append(f"{path.relative_to(ROOT)}:{line.lineno}: {text.splitlines()[0]}")
    assert not wrong, "\n".join(wrong)


def test_no_two_public_classes_have_one_name():
    places: dict[str, list[str]] = {}
    for path in SOURCES:
        for node in nodes_of(path, DEFINING):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places.setdefault(node.name, []).append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert {name: lines for name, lines in places.items() if len(lines) > 1} == {}


def test_long_files_say_why():
    lines = {path: path.read_text(encoding="utf-8").splitlines() for path in SOURCES}
    long = [path for path, text in lines.items() if len(text) > 500]
    assert [path for path in long if "long because" not in " ".join(lines[path][:40])] == []


def test_the_extension_starts_no_other_process_opens_no_connection_and_runs_no_text():
    """Check what docs/extension-review.md promises."""
    banned = {"subprocess", "multiprocessing", "socket", "http", "urllib", "requests", "ftplib", "webbrowser"}
    for path in SOURCES:
        for node in nodes_of(path):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) and not node.level else []
            # Of mphdrr events make --workers, and of the look at HDF5 files that have no seal.
            allowed = {"pool.py": {"multiprocessing"}, "hdf5.py": {"subprocess"}}.get(path.name, set())
            assert not (banned - allowed) & {name.partition(".")[0] for name in names}, path
            called = getattr(getattr(node, "func", None), "id", "")
            assert called not in ("eval", "exec"), path


def test_links_of_the_readme_lead_to_files():
    """Check the links that `make docs` does not, which checks those in docs/."""
    links = re.findall(r"\]\(([^)#]+)", (ROOT / "README.md").read_text(encoding="utf-8"))
    assert links and [link for link in links if not (ROOT / link).is_file()] == []


def test_imports_inside_the_package_are_relative():
    """Check that no name depends on the place: as an extension the package is called bl_ext.<repository>.mphdrr."""
    absolute = re.compile(r"^\s*(from|import) mphdrr\b", re.MULTILINE)
    assert [path for path in SOURCES if absolute.search(path.read_text(encoding="utf-8"))] == []


PARSERS = "from mphdrr.addon.cli import COMMANDS; from mphdrr.core.cli import build_parser; build_parser(COMMANDS)"
WORKING = {
    "workbook",
    "design",
    "runs.run_recipe",
    "runs.files",
    "events.event_files",
    "learning.data",
    "figures.scores",
}


@pytest.mark.parametrize(
    ("script", "unwanted"),
    [
        ("import mphdrr", {"numpy", "bpy", "mphdrr.core", "mphdrr.addon"}),
        ("import mphdrr.core", {"bpy", "torch", "h5py", "trimesh", "PIL", "nibabel", "scipy", "openpyxl"}),
        ("import mphdrr.core.projector", {"torch"}),
        # Options and help of all commands, so that they and completion are quick.
        (PARSERS, {f"mphdrr.core.{name}" for name in WORKING} | {"bpy", "h5py", "torch", "trimesh"}),
    ],
)
def test_imports_and_help_load_nothing_heavy(script: str, unwanted: set[str]):
    done = run_python(f"{script}\nimport sys; print(*({unwanted!r} & set(sys.modules)))")
    assert (done.returncode, done.stdout.strip()) == (0, ""), done.stderr


@pytest.mark.parametrize("path", [path for path in SOURCES if "bpy" in path.read_text(encoding="utf-8")], ids=str)
def test_labels_can_be_translated(path):
    """Check that labels are texts that a catalogue can have: values are put in after `pgettext_iface`."""
    for call in nodes_of(path):
        for keyword in call.keywords if isinstance(call, ast.Call) else ():
            if keyword.arg in ("text", "heading", "placeholder") and isinstance(keyword.value, ast.JoinedStr):
                words = [part.value for part in keyword.value.values if isinstance(part, ast.Constant)]
                assert not any(letter.isalpha() for word in words for letter in word), f"line {keyword.value.lineno}"


OPENING = {"open", "fdopen", "File", "ZipFile", "GzipFile"}
WRITING = {"write_text", "write_bytes", "tofile", "copyfile", "copy2", "symlink_to", "hardlink_to"}


def writes(call: ast.Call) -> bool:
    """Return whether a call writes or moves a file, other than to `temporary`, which `core/files.py` gives, or in memory."""
    method = call.func if isinstance(call.func, ast.Attribute) else None
    name = method.attr if method else getattr(call.func, "id", "")
    texts = [part.value for part in ast.walk(call) if isinstance(part, ast.Constant) and isinstance(part.value, str)]
    is_writing = method is not None and (name in WRITING or ast.unparse(method) in ("os.replace", "shutil.move"))
    is_writing |= name in OPENING and any(re.fullmatch("[rbt]*([wax][bt]*|[+])[bt+]*", text) for text in texts)
    concerned = [*call.args[:2], *([method.value] if method else [])]
    names = {leaf.id for part in concerned for leaf in ast.walk(part) if isinstance(leaf, ast.Name)}
    return is_writing and not names & {"temporary", "memory", "buffer", "out"}


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("open(path, 'w')", True),
        ("path.open(mode='r+b')", True),
        ("h5py.File(path, 'a')", True),
        ("path.write_text(text)", True),
        ("shutil.copyfile(a, b)", True),
        ("os.replace(a, b)", True),
        ("open(path, 'rb')", False),
        ("shutil.copyfile(file, temporary)", False),
        ("(temporary / 'a').write_text(text)", False),
        ("h5py.File(memory, 'w')", False),
        ("text.replace('w', 'a')", False),
    ],
)
def test_writing_is_recognized(text, wrong):
    assert writes(ast.parse(text).body[0].value) == wrong


def test_only_one_file_writes_files():
    """Check that all others write through it, so that the old or the new file is whole, also when the disk is full.

    The two files of event sets that only grow at their ends are exceptions: their readers leave out an incomplete end.
    """
    for path in set(SOURCES) - {ROOT / "core" / name for name in ("files.py", "events/index.py", "events/store.py")}:
        calls = [node for node in nodes_of(path) if isinstance(node, ast.Call)]
        assert [call.lineno for call in calls if writes(call)] == [], path


def test_the_tests_that_the_pages_name_are_there():
    files: dict[str, str] = {}
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        files[path.name] = files.get(path.name, "") + path.read_text(encoding="utf-8")
    everything = "".join(files.values())
    for page in sorted((ROOT / "docs").glob("*.md")):
        for line in page.read_text(encoding="utf-8").splitlines():
            named = {Path(name).name for name in re.findall(r"`([\w/]*test_\w+\.py)`", line)}
            assert named <= files.keys(), page.name
            text = "".join(map(files.get, named)) if line.startswith("|") and named else everything
            missing = [name for name in re.findall(r"`(test_\w+)`", line) if f"def {name}(" not in text]
            assert not missing, page.name
