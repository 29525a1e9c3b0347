"""Add the library of the C kernels, and stubs for type checkers, to the package that pyproject.toml describes."""

import ast
import os
import sys
from pathlib import Path

from setuptools import setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_py import build_py

ROOT = Path(__file__).resolve().parent
sys.path.insert(0, str(ROOT / "tools"))
import build_kernels  # noqa: E402

# Their imports are what others find there.
PUBLIC = ("core", "core/events", "core/projector", "core/workbook")


def stub_of(source):
    """Return the stub of a package's public interface: for type checkers an import counts if it names each name twice."""
    body = ast.parse(source).body
    body = next((node.body for node in body if isinstance(node, ast.If)), body)  # imports for type checkers alone
    imports = [node for node in body if isinstance(node, ast.ImportFrom) and node.module != "lazy"]
    lines = [
        f"from {'.' * node.level}{node.module or ''} import {name.name} as {name.name}\n"
        for node in imports
        for name in node.names
    ]
    return "".join(lines)


class WithKernels(build_py):
    """Build step that adds the library to the package; to the tree itself for `pip install -e`."""

    def find_package_modules(self, package, package_dir):
        """Return the package's own modules, without this file, which lies beside them."""
        return [
            found for found in super().find_package_modules(package, package_dir) if found[:2] != ("mphdrr", "setup")
        ]

    def run(self):
        """Build the library and the stubs, or warn that there is no library for this machine."""
        super().run()
        if not self.editable_mode:
            for package in PUBLIC:
                source = (ROOT / package / "__init__.py").read_text(encoding="utf-8")
                Path(self.build_lib, "mphdrr", package, "__init__.pyi").write_text(stub_of(source), encoding="utf-8")
        if name := self.get_finalized_command("bdist_wheel").kernels:
            folder = build_kernels.KERNELS.relative_to(ROOT)
            build_kernels.build(name, ROOT / folder if self.editable_mode else Path(self.build_lib, "mphdrr", folder))
        else:
            self.warn("the C kernels are not built: torch or numpy does the work, many times slower")


class PlatformWheel(bdist_wheel):
    """A wheel for one platform and any Python; `--plat-name windows-x64` and the like ask for another than this."""

    def finalize_options(self):
        """Choose the platform."""
        without = os.environ.get(build_kernels.WITHOUT_KERNELS)
        self.kernels = None if without else self.plat_name or build_kernels.this_platform()
        super().finalize_options()

    def get_tag(self):
        """Return the parts of the wheel's name that say where it fits."""
        return ("py3", "none", build_kernels.PLATFORMS[self.kernels].tag) if self.kernels else super().get_tag()


setup(cmdclass={"build_py": WithKernels, "bdist_wheel": PlatformWheel})
