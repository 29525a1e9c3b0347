"""The contenders: each makes, of a `Case`, the calls that are timed.

A peer's methods ``forward``, ``adjoint``, ``emission`` and ``pose_gradient`` prepare (convert the volume, set up the
geometry) and return a function without arguments that does the work and returns

- forward: line integrals (n_views, n_v, n_u) of the case's volume, value x mm;
- adjoint: an array (n_x, n_y, n_z) of ``case.images``;
- emission: counts of the ideal pinhole (n_views, n_v, n_u), attenuated by "mu";
- pose_gradient: derivatives (n_views, 6) of ``(weights * integrals).sum()`` by `motion`, of the volume "smooth".

What a peer cannot do, it does not have. Making one raises ImportError where its library is missing.
"""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from case import Case

import mphdrr.core as mph
from mphdrr.core.rays import backends

Call = Callable[[], np.ndarray]
TASKS = ("forward", "adjoint", "emission", "pose_gradient")
RAYS_AT_ONCE = 4096  # for peers that hold all samples of all rays at once
RADIUS = 100.0  # mm of motion that count as much as a radian


class Peer:
    """A contender.

    Attributes
    ----------
    label : str
    model : str
        Of the line integral.
    slow : bool
        One view and few turns are enough of it.
    cpu : bool
        Whether it depends on the number of threads.
    """

    label = ""
    model = "exact"
    slow = False
    cpu = True

    def __init__(self, threads: int) -> None:
        self.threads = threads

    @classmethod
    def tasks(cls) -> tuple[str, ...]:
        """Return the names of the tasks that the contender can do."""
        return tuple(task for task in TASKS if hasattr(cls, task))


class Ours(Peer):
    """The contender of one of mphDRR's backends."""

    backend = ""

    def __init__(self, threads: int) -> None:
        super().__init__(threads)
        try:
            backends.choose(self.backend)
        except mph.InputError as error:
            raise ImportError(str(error)) from None
        if self.backend == "torch":
            import torch

            torch.set_num_threads(threads)

    def _projector(self, case: Case, model: mph.Emission | None = None) -> mph.Projector:
        return mph.Projector(case.grid, case.views, model, self.backend, threads=self.threads)

    def forward(self, case: Case, volume: str = "noise") -> Call:
        """Prepare the line integrals of `volume`."""
        A, x = self._projector(case), case.volume(volume)
        return lambda: A(x)

    def adjoint(self, case: Case) -> Call:
        """Prepare the adjoint of the case's images."""
        A, images = self._projector(case), case.images
        return lambda: A.T(images)

    def emission(self, case: Case) -> Call:
        """Prepare the attenuated counts of the ideal pinhole."""
        mu = mph.Volume(case.volume("mu"), case.grid, "mu")
        # One ray a pixel, through the middle of the hole, as all contenders.
        model = mph.Emission(case.system, mu, hole="point", pixel_points=1, tolerance=1e9)
        A, x = self._projector(case, model), case.volume("noise")
        return lambda: A(x)

    def pose_gradient(self, case: Case) -> Call:
        """Prepare the images' derivatives by the poses."""
        from mphdrr.core.projector.torch_cameras import pinhole_images

        volume = mph.Volume(case.volume("smooth"), case.grid)

        def integrate(m: int, camera: Any) -> Any:
            position, rotation, distance, pitch = camera
            return pinhole_images(volume, position, rotation, distance, pitch, case.views.shape, backend=self.backend)

        return _pose_gradient(case, integrate)


def ours(backend: str) -> type[Ours]:
    """Return the contender class of one of mphDRR's backends."""
    label = f"mphDRR, {backend}" + (" (float64)" if backend == "numpy" else "")
    facts = {"backend": backend, "label": label, "slow": backend in ("torch", "numpy"), "cpu": backend != "cuda"}
    return type(backend, (Ours,), facts)


class PlainC(Peer):
    """`siddon.c`, compiled here."""

    label = "plain C, OpenMP"

    def __init__(self, threads: int) -> None:
        super().__init__(threads)
        compiler = shutil.which("cc")
        if compiler is None:
            raise ImportError("there is no compiler cc")
        folder = tempfile.mkdtemp(prefix="mphdrr-siddon-")
        try:
            library = Path(folder) / "siddon.so"
            command = [compiler, *["-O3", "-march=native", "-fopenmp", "-shared", "-fPIC"], "-o", str(library)]
            done = subprocess.run(
                [*command, str(Path(__file__).with_name("siddon.c")), "-lm"], capture_output=True, text=True
            )
            if done.returncode:
                raise ImportError(f"{compiler} could not compile siddon.c: {done.stderr.strip().splitlines()[-1]}")
            self._library = ctypes.CDLL(str(library))
        finally:
            shutil.rmtree(folder)

    def forward(self, case: Case, volume: str = "noise") -> Call:
        """Prepare the line integrals of `volume`."""
        return self._images(case, self._library.forward, case.volume(volume))

    def emission(self, case: Case) -> Call:
        """Prepare the attenuated counts of the ideal pinhole."""
        weights = case.emission_weights
        call = self._images(case, self._library.attenuated, case.volume("noise"), case.volume("mu"))
        return lambda: weights * call()

    def adjoint(self, case: Case) -> Call:
        """Prepare the adjoint of the case's images."""
        images, geometry = case.images, self._geometry(case)

        def call() -> np.ndarray:
            volume = np.zeros(case.grid.shape, np.float32)
            if not self._library.adjoint(_pointer(volume), *geometry, _pointer(images)):
                raise MemoryError
            return volume

        return call

    def _images(self, case: Case, function: Any, *volumes: np.ndarray) -> Call:
        geometry = self._geometry(case)

        def call() -> np.ndarray:
            images = np.empty((case.n_views, *case.views.shape), np.float32)
            function(*map(_pointer, volumes), *geometry, _pointer(images))
            return images

        return call

    def _geometry(self, case: Case) -> tuple[Any, ...]:
        views, (n_v, n_u) = case.views, case.views.shape
        linear, offset = case.grid.index_from_world[:3, :3].T, case.grid.index_from_world[:3, 3] + 0.5
        first = views.detector_centers - (n_u - 1) / 2 * views.u_steps - (n_v - 1) / 2 * views.v_steps
        cameras = [
            views.sources @ linear + offset,
            first @ linear + offset,
            views.u_steps @ linear,
            views.v_steps @ linear,
        ]
        self._cameras = np.ascontiguousarray(np.concatenate(cameras, axis=1))
        size = ctypes.c_double(case.grid.spacing[0])
        return (ctypes.c_int * 3)(*case.grid.shape), size, _pointer(self._cameras), len(views), n_v, n_u


class Rtk(Peer):
    """itk-rtk: interpolates in the planes of each ray's dominant axis (Joseph). Attenuates towards the detector."""

    label, model = "itk-rtk (Joseph)", "interpolated"

    def __init__(self, threads: int) -> None:
        super().__init__(threads)
        import itk
        from itk import RTK

        itk.MultiThreaderBase.SetGlobalDefaultNumberOfThreads(threads)
        itk.MultiThreaderBase.SetGlobalMaximumNumberOfThreads(threads)
        self._itk, self._rtk, self._image = itk, RTK, itk.Image[itk.F, 3]
        self.label = f"itk-rtk {version('itk-rtk')} (Joseph)"

    def forward(self, case: Case, volume: str = "noise") -> Call:
        """Prepare the line integrals of `volume`."""
        return self._images(case, self._rtk.JosephForwardProjectionImageFilter, volume)

    def emission(self, case: Case) -> Call:
        """Prepare the attenuated counts of the ideal pinhole."""
        weights = case.emission_weights
        call = self._images(case, self._rtk.JosephForwardAttenuatedProjectionImageFilter, "noise", "mu")
        return lambda: weights * call()

    def adjoint(self, case: Case) -> Call:
        """Prepare the adjoint of the case's images."""
        geometry, stack = self._geometry(case), self._stack(case, case.images)

        def call() -> np.ndarray:
            filter = self._rtk.JosephBackProjectionImageFilter[self._image, self._image].New()
            filter.SetInput(0, self._volume(case, np.zeros(case.grid.shape, np.float32)))
            filter.SetInput(1, stack)
            return self._run(filter, geometry).T

        return call

    def _images(self, case: Case, kind: Any, *names: str) -> Call:
        geometry = self._geometry(case)
        volumes = [self._volume(case, case.volume(name)) for name in names]

        def call() -> np.ndarray:
            filter = kind[self._image, self._image].New()
            # The filter works in the place of this one.
            filter.SetInput(0, self._stack(case, np.zeros_like(case.images)))
            for i, volume in enumerate(volumes):
                filter.SetInput(1 + i, volume)
            return self._run(filter, geometry)

        return call

    def _run(self, filter: Any, geometry: Any) -> np.ndarray:
        filter.SetGeometry(geometry)
        filter.Update()
        return self._itk.array_from_image(filter.GetOutput())

    def _geometry(self, case: Case) -> Any:
        point, vector = self._itk.Point[self._itk.D, 3], self._itk.Vector[self._itk.D, 3]
        geometry, views = self._rtk.ThreeDCircularProjectionGeometry.New(), case.views
        for m in range(len(views)):
            u, v = (step / np.linalg.norm(step) for step in (views.u_steps[m], views.v_steps[m]))
            places = (point(views.sources[m].tolist()), point(views.detector_centers[m].tolist()))
            if not geometry.AddProjection(*places, vector(u.tolist()), vector(v.tolist())):
                raise RuntimeError(f"RTK refuses view {m}")
        return geometry

    def _volume(self, case: Case, array: np.ndarray) -> Any:
        image = self._itk.image_from_array(np.ascontiguousarray(array.T))  # a copy: it owns its voxels
        image.SetSpacing(case.grid.spacing.tolist())
        image.SetOrigin(case.grid.affine[:3, 3].tolist())
        return image

    def _stack(self, case: Case, images: np.ndarray) -> Any:
        pitch = [float(np.linalg.norm(steps[0])) for steps in (case.views.u_steps, case.views.v_steps)]
        stack = self._itk.image_from_array(images)
        stack.SetSpacing([*pitch, 1.0])
        stack.SetOrigin([-(n - 1) / 2 * p for n, p in zip(reversed(case.views.shape), pitch, strict=True)] + [0.0])
        return stack


class Plastimatch(Peer):
    """The program `plastimatch drr`, view by view. It reads and writes files; its own clock is asked, without that."""

    label = "plastimatch"

    def __init__(self, threads: int) -> None:
        super().__init__(threads)
        import plastimatch

        self._program = Path(plastimatch.__file__).parent / "bin" / "plastimatch"
        self.label = f"plastimatch {version('plastimatch')} (exact)"
        self.own_seconds = 0.0

    def forward(self, case: Case, volume: str = "noise") -> Call:
        """Prepare the line integrals of `volume`."""
        folder = tempfile.TemporaryDirectory(prefix="mphdrr-plastimatch-", dir=case.folder)
        file = Path(folder.name) / "volume.mha"
        n, size, origin = case.voxels, case.grid.spacing, case.grid.affine[:3, 3]
        header = [
            "ObjectType = Image", "NDims = 3", "BinaryData = True", "BinaryDataByteOrderMSB = False",
            "CompressedData = False", "TransformMatrix = 1 0 0 0 1 0 0 0 1", f"Offset = {_words(origin)}",
            f"ElementSpacing = {_words(size)}", f"DimSize = {n} {n} {n}", "ElementType = MET_FLOAT",
            "ElementDataFile = LOCAL", "",
        ]  # fmt: skip
        file.write_bytes("\n".join(header).encode() + np.ascontiguousarray(case.volume(volume).T).tobytes())

        def call() -> np.ndarray:
            self.own_seconds = 0.0
            return np.stack([self._view(case, m, Path(folder.name)) for m in range(case.n_views)])

        return call

    def _view(self, case: Case, m: int, folder: Path) -> np.ndarray:
        views, (n_v, n_u) = case.views, case.views.shape
        u, v = (np.linalg.norm(steps[m]) for steps in (views.u_steps, views.v_steps))
        along = views.detector_centers[m] - views.sources[m]
        sid = np.linalg.norm(along)
        # The isocentre lies on the principal ray; rows and columns run the other way.
        command = [
            str(self._program), "drr", "-i", "exact", "-A", "cpu", "-P", "none", "-t", "raw", "-O", "image_",
            "-r", f"{n_v} {n_u}", "-z", f"{n_v * v} {n_u * u}", "-o", "0 0 0", "--sid", str(sid),
            "--sad", str(np.linalg.norm(views.sources[m])), "-n", _words(-along / sid),
            "--vup", _words(views.v_steps[m] / v), "volume.mha",
        ]  # fmt: skip
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
        total, files = (
            float(re.search(rf"{what} time: *([\d.e+-]+)", done.stdout)[1])  # type: ignore[index]
            for what in ("Total", "I/O")
        )
        self.own_seconds += total - files
        image = np.fromfile(folder / "image_0000.raw", np.float32).reshape(n_v, n_u)
        return 10 * image[::-1, ::-1]  # it counts in cm


class TorchPeer(Peer):
    """A renderer in torch that takes rays: forward in chunks, all derivatives by autograd."""

    slow = True

    def __init__(self, threads: int) -> None:
        super().__init__(threads)
        import torch

        torch.set_num_threads(threads)
        self._torch = torch

    def renderer(self, case: Case, volume: Any) -> Callable[[Any, Any], Any]:
        """Return a function that integrates `volume`, a tensor, along rays between world points (N, 3)."""
        raise NotImplementedError

    def forward(self, case: Case, volume: str = "noise") -> Call:
        """Prepare the line integrals of `volume`."""
        torch = self._torch
        render = self.renderer(case, torch.from_numpy(case.volume(volume)))
        rays = [[torch.from_numpy(np.array(ends)) for ends in case.views.rays(m)] for m in range(case.n_views)]

        def call() -> np.ndarray:
            with torch.no_grad():
                images = [torch.cat([render(*ends) for ends in self._chunks(*r)]) for r in rays]
            return torch.stack(images).reshape(case.n_views, *case.views.shape).numpy()

        return call

    def adjoint(self, case: Case) -> Call:
        """Prepare the adjoint of the case's images."""
        torch = self._torch
        volume = torch.zeros(case.grid.shape, requires_grad=True)
        render = self.renderer(case, volume)
        rays = [[torch.from_numpy(np.array(ends)) for ends in case.views.rays(m)] for m in range(case.n_views)]
        images = torch.from_numpy(case.images).flatten(1)

        def call() -> np.ndarray:
            volume.grad = None
            for image, r in zip(images, rays, strict=True):
                for values, ends in zip(image.split(RAYS_AT_ONCE), self._chunks(*r), strict=True):
                    (render(*ends) * values).sum().backward()
            return volume.grad.numpy()

        return call

    def pose_gradient(self, case: Case) -> Call:
        """Prepare the images' derivatives by the poses."""
        from mphdrr.core.projector.torch_cameras import pinhole_rays

        torch = self._torch
        render = self.renderer(case, torch.from_numpy(case.volume("smooth")))

        def integrate(m: int, camera: Any) -> Any:
            sources, targets = pinhole_rays(*camera, case.views.shape)
            return torch.cat(
                [
                    torch.utils.checkpoint.checkpoint(render, *ends, use_reentrant=False)
                    for ends in self._chunks(sources, targets)
                ]
            ).reshape(case.views.shape)

        return _pose_gradient(case, integrate)

    def _chunks(self, *points: Any) -> Any:
        return zip(*(x.split(RAYS_AT_ONCE) for x in points), strict=True)


class DiffDRR(TorchPeer):
    """DiffDRR's renderer by Siddon's method, in world coordinates."""

    label = "DiffDRR (exact)"

    def __init__(self, threads: int) -> None:
        super().__init__(threads)
        from diffdrr.renderers import Siddon

        self._siddon = Siddon(voxel_shift=0.5)
        self.label = f"DiffDRR {version('diffdrr')} (Siddon)"

    def renderer(self, case: Case, volume: Any) -> Callable[[Any, Any], Any]:
        """Return the function that renders rays through `volume`."""
        to_index = self._torch.from_numpy(np.array(case.grid.index_from_world))

        def render(sources: Any, targets: Any) -> Any:
            lengths = (targets - sources).norm(dim=-1).float()
            ends = [(x @ to_index[:3, :3].T + to_index[:3, 3]).float()[None] for x in (sources, targets)]
            return self._siddon(volume, *ends, lengths[None, None])[0, 0]

        return render


class NanoDRR(TorchPeer):
    """nanodrr's renderer, which samples the interpolated volume; the number of samples is its default."""

    model, samples = "500 samples", 500
    label = "nanodrr"

    def __init__(self, threads: int) -> None:
        super().__init__(threads)
        from nanodrr.drr.backends import render_torch

        self._render = render_torch
        self.label = f"nanodrr {version('nanodrr')} (torch)"

    def renderer(self, case: Case, volume: Any) -> Callable[[Any, Any], Any]:
        """Return the function that renders rays through `volume`."""
        torch = self._torch
        # grid_sample wants (D, H, W) voxels and, as points, (x, y, z) in -1..1 from face to face of (W, H, D).
        normalized = np.diag([*(2 / np.array(case.grid.shape)), 1.0])
        normalized[:3, 3] = 1 / np.array(case.grid.shape) - 1
        subject = SimpleNamespace(
            image=volume.permute(2, 1, 0).contiguous()[None, None],
            world_to_grid=torch.from_numpy(normalized @ case.grid.index_from_world).float()[None],
            n_classes=1,
        )

        def render(sources: Any, targets: Any) -> Any:
            source, target = sources.float()[None], targets.float()[None]
            step = (target - source).norm(dim=-1) / self.samples
            return self._render(subject, torch.eye(4)[None], source, target, step, self.samples, 1, step.shape[1])[
                0, 0, 0
            ]

        return render


class DiffCT(Peer):
    """diffct's projector of cone beams."""

    label = "diffct"
    slow = True

    def __init__(self, threads: int) -> None:
        super().__init__(threads)
        import diffct
        import torch

        torch.set_num_threads(threads)
        self._torch, self._diffct = torch, diffct
        self.label = f"diffct {version('diffct')} (torch)"

    def forward(self, case: Case, volume: str = "noise") -> Call:
        """Prepare the line integrals of `volume`."""
        A, x = self._projector(case), self._torch.from_numpy(np.ascontiguousarray(case.volume(volume).T))
        return lambda: A.project(x).mT.numpy()

    def adjoint(self, case: Case) -> Call:
        """Prepare the adjoint of the case's images."""
        A, images = self._projector(case), self._torch.from_numpy(case.images).mT.contiguous()
        return lambda: A.backproject(images).numpy().T

    def _projector(self, case: Case) -> Any:
        views = case.views
        pitch = [float(np.linalg.norm(steps[0])) for steps in (views.u_steps, views.v_steps)]
        trajectory = (views.sources, views.detector_centers, views.u_steps / pitch[0], views.v_steps / pitch[1])
        return self._diffct.Projector(
            tuple(self._torch.tensor(x, dtype=self._torch.float32) for x in trajectory), tuple(reversed(case.grid.shape)),
            tuple(reversed(views.shape)), detector_spacing=tuple(pitch), voxel_spacing=float(case.grid.spacing[0]),
            backend="torch", precision="float32",
        )  # fmt: skip


PEERS: dict[str, type[Peer]] = {
    **{backend: ours(backend) for backend in backends.BACKENDS},
    "c": PlainC,
    "rtk": Rtk,
    "plastimatch": Plastimatch,
    "nanodrr": NanoDRR,
    "diffct": DiffCT,
    "diffdrr": DiffDRR,
}


def _pose_gradient(case: Case, integrate: Callable[[int, Any], Any]) -> Call:
    """Return the call of a differentiable renderer ``integrate(m, (position, rotation, distance, pitch))``."""
    import torch

    from mphdrr.core.geometry.rotations import se3_exp

    poses = torch.from_numpy(case.system.poses()).float()  # as its users optimise them
    distances = np.linalg.norm(case.views.detector_centers - case.views.sources, axis=1)
    pitches = np.linalg.norm(case.views.u_steps, axis=1)
    weights = torch.from_numpy(case.images)
    scale = torch.tensor([RADIUS] * 3 + [1.0] * 3)

    def call() -> np.ndarray:
        gradients = []
        for m in range(case.n_views):
            motion = torch.zeros(6, requires_grad=True)
            pose = se3_exp(scale * motion) @ poses[m]
            image = integrate(m, (pose[:3, 3], pose[:3, :3], distances[m], pitches[m]))
            # Not a product and a sum in torch, whose threads would then wait, busily, beside the contender's.
            image.backward(weights[m])
            gradients.append(motion.grad.numpy())  # type: ignore[union-attr]
        return np.stack(gradients)

    return call


def _pointer(array: np.ndarray) -> ctypes.c_void_p:
    assert array.flags.c_contiguous
    return ctypes.c_void_p(array.ctypes.data)


def _words(numbers: np.ndarray) -> str:
    return " ".join(f"{x:.12g}" for x in numbers)


def set_thread_variables(environment: dict[str, str], threads: int) -> None:
    """Set the environment variables that libraries read when they are loaded."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "ITK_GLOBAL_DEFAULT_NUMBER_OF_THREADS"):
        environment[name] = str(threads)


def cores() -> list[int]:
    """Return the processor cores that this process may use."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(os.cpu_count() or 1))
