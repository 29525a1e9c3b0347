"""Adds the library of the C kernels to the package that pyproject.toml describes."""

import sys
from pathlib import Path

from setuptools import setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_py import build_py

ROOT = Path(__file__).resolve().parent
sys.path.insert(0, str(ROOT / "tools"))
import build_kernels  # noqa: E402


class WithKernels(build_py):
    """Builds the library into the package; into the tree itself for `pip install -e`."""

    def run(self):
        """Do so, or say that there is none for this machine."""
        super().run()
        if name := self.get_finalized_command("bdist_wheel").kernels:
            folder = build_kernels.KERNELS.relative_to(ROOT)
            build_kernels.build(name, ROOT / folder if self.editable_mode else Path(self.build_lib, "mphdrr", folder))
        else:
            self.warn("the C kernels are not built for this machine: torch and numpy do the work")


class PlatformWheel(bdist_wheel):
    """A wheel for one platform and any Python; `--plat-name windows-x64` and the like ask for another than this."""

    def finalize_options(self):
        """Choose the platform."""
        self.kernels = self.plat_name or build_kernels.this_platform()
        super().finalize_options()

    def get_tag(self):
        """Give the parts of the wheel's name that say where it fits."""
        return ("py3", "none", build_kernels.PLATFORMS[self.kernels].tag) if self.kernels else super().get_tag()


setup(cmdclass={"build_py": WithKernels, "bdist_wheel": PlatformWheel})
