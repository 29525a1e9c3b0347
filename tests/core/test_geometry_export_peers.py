"""The exported files in the programs themselves: `make test-peers` runs these tests with all of them installed."""

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.geometry.collimator import Construction

from .test_geometry_export import arrays, detector_of, fiducials, general_views, project


@pytest.fixture(params=["scanner", "real detector", "any pose", "mirrored"])
def views(request, scanner, rng):
    if request.param == "scanner":
        return scanner.views()
    if request.param == "real detector":
        return scanner.views((65, 32), "real", pitch=(0.9, 1.3), offset=(3.0, -7.0))
    return general_views(rng, mirrored=request.param == "mirrored")


def test_opencv_projects_alike(views, system, rng, tmp_path):
    cv2 = pytest.importorskip("cv2", reason="no OpenCV")
    mph.write_geometry(system, tmp_path / "a.npz", "opencv", views=views)
    a, points = arrays(tmp_path / "a.npz"), fiducials(views, rng)
    for m, expected in enumerate(project(views, points)):
        rvec, _ = cv2.Rodrigues(a["R"][m])
        seen, _ = cv2.projectPoints(points[m], rvec, a["t"][m], a["K"][m], None)
        assert np.abs(seen[:, 0] - expected).max() < 1e-6


def test_kornia_projects_alike(views, system, rng, tmp_path):
    torch = pytest.importorskip("torch", reason="no torch")
    camera = pytest.importorskip("kornia.geometry.camera", reason="no kornia")
    mph.write_geometry(system, tmp_path / "a.npz", "kornia", views=views)
    points = fiducials(views, rng)
    pinhole = camera.PinholeCamera(**{name: torch.from_numpy(a) for name, a in arrays(tmp_path / "a.npz").items()})
    assert np.abs(pinhole.project(torch.from_numpy(points)).numpy() - project(views, points)).max() < 1e-6


def imported_rtk():
    itk = pytest.importorskip("itk", reason="no itk-rtk")
    if not hasattr(itk, "RTK"):
        pytest.skip("no itk-rtk")
    return itk, itk.RTK


def test_rtk_reads_the_geometry(views, system, rng, tmp_path):
    itk, rtk = imported_rtk()
    mph.write_geometry(system, tmp_path / "a.xml", "rtk", views=views)
    points = fiducials(views, rng)
    spacing, origin = detector_of((tmp_path / "a.xml").read_text())
    geometry = rtk.read_geometry(str(tmp_path / "a.xml"))
    for m, expected in enumerate(project(views, points)):
        matrix = itk.array_from_matrix(geometry.GetMatrix(m))
        seen = np.c_[points[m], np.ones(len(points[m]))] @ matrix.T
        assert np.abs((seen[:, :2] / seen[:, 2:] - origin) / spacing - expected).max() < 1e-6
        assert np.allclose(list(geometry.GetSourcePosition(m))[:3], views.sources[m])


def rtk_images(system, views, grid, array, path):
    """Return images by RTK's Joseph projector, of the geometry that is written to `path`."""
    itk, rtk = imported_rtk()
    mph.write_geometry(system, path, "rtk", views=views)
    spacing, origin = detector_of(path.read_text())
    volume = itk.image_from_array(np.ascontiguousarray(array.astype(np.float32).T))
    volume.SetSpacing(grid.spacing)
    volume.SetOrigin(grid.affine[:3, 3])
    stack = itk.image_from_array(np.zeros((len(views), *views.shape), np.float32))
    stack.SetSpacing([*spacing, 1.0])
    stack.SetOrigin([*origin, 0.0])
    image = itk.Image[itk.F, 3]
    joseph = rtk.JosephForwardProjectionImageFilter[image, image].New()
    joseph.SetInput(0, stack)
    joseph.SetInput(1, volume)
    joseph.SetGeometry(rtk.read_geometry(str(path)))
    joseph.Update()
    return itk.array_from_image(joseph.GetOutput())


def test_rtk_projects_alike(scanner, tmp_path):
    """On a smooth volume: the arrays fit as they are, whatever the sign of RTK's distances."""
    imported_rtk()
    system = scanner[::16]
    for detector in ("virtual", "real"):
        views = system.views((24, 30), detector, offset=(4.0, 0.0))
        grid = mph.Grid.centered((60, 50, 40), (1.5, 2.0, 2.0), (4.0, -3.0, 6.0))
        x, y, z = np.meshgrid(*(np.arange(n) / n for n in grid.shape), indexing="ij")
        smooth = np.sin(np.pi * x) * np.sin(np.pi * y) * np.sin(np.pi * z) * (1 + x)
        seen = rtk_images(system, views, grid, smooth, tmp_path / "a.xml")
        expected = mph.Projector(grid, views)(smooth)
        assert np.abs(seen - expected).max() < 0.02 * expected.max()


def test_rtk_transmits_the_same_of_a_spectrum(tmp_path):
    """A body of water with bone, before X-ray sources of both presets: transmissions of energy bins within 1 %."""
    imported_rtk()
    grid = mph.Grid.centered((170, 170, 400), (1.25, 1.25, 0.5))
    places = [(np.arange(n) - (n - 1) / 2) * size for n, size in zip(grid.shape, grid.spacing, strict=True)]
    away = np.sqrt(sum(each**2 for each in np.meshgrid(*places, indexing="ij")))
    water, bone = (1 / (1 + np.exp((away - radius) / 8)) for radius in (60.0, 20.0))  # smooth: RTK interpolates
    for system in (
        mph.xray_arc(3, start=np.radians(-60), end=np.radians(-30), panel_size=(300, 300), shape=(24, 24)),
        mph.xray_ring(4, shape=(24, 24)),
    ):
        views = system.views()
        m = mph.SpectralTransmission(
            views, mph.tube_spectrum(120).coarser(4), ("water", "bone"), ((20, 60), (60, 120)), mph.PhotonCounter()
        )
        air = m.expected(np.zeros((2, len(views), *views.shape)), 1.0)
        paths = [rtk_images(system, views, grid, each, tmp_path / "a.xml") for each in (water - bone, bone)]
        theirs = m.expected(np.array(paths, float), 1.0) / air
        ours = m.project([water - bone, bone], mph.Projector(grid, views), 1.0) / air
        assert ours.min() < 0.005 and np.abs(theirs / ours - 1).max() < 0.01


def test_astra_takes_the_geometry(views, system, rng, tmp_path):
    astra = pytest.importorskip("astra", reason="no ASTRA Toolbox", exc_type=ImportError)
    mph.write_geometry(system, tmp_path / "a.npz", "astra", views=views, grid=mph.Grid.centered((4, 6, 10), 2.0))
    a = arrays(tmp_path / "a.npz")
    geometry = astra.create_proj_geom("cone_vec", int(a["det_row_count"]), int(a["det_col_count"]), a["vectors"])
    n_v, n_u = views.shape
    assert astra.geom_size(geometry) == (n_v, len(views), n_u)
    volume = astra.create_vol_geom(*a["volume_counts"].tolist(), *a["volume_windows"].tolist())
    assert astra.geom_size(volume) == (10, 6, 4)
    identifier = astra.data3d.create("-sino", geometry)  # ASTRA refuses wrong vectors
    astra.data3d.delete(identifier)


def test_lib3mf_reads_the_solids_in_strict_mode(scanner, tmp_path):
    """Every part is a closed, oriented surface with its name, in millimetres, and there is no warning."""
    wrapper = pytest.importorskip("lib3mf", reason="no lib3mf").get_wrapper()
    system = scanner[::10]
    mph.write_geometry(system, tmp_path / "a.3mf", "3mf", edge_at="front")
    model = wrapper.CreateModel()
    reader = model.QueryReader("3mf")
    reader.SetStrictModeActive(True)
    reader.ReadFromFile(str(tmp_path / "a.3mf"))
    assert reader.GetWarningCount() == 0
    assert model.GetUnit().name == "MilliMeter"
    expected = {part.name: part for part in system.parts(Construction(edge_at="front"))}
    objects = model.GetMeshObjects()
    while objects.MoveNext():
        seen = objects.GetCurrentMeshObject()
        part = expected.pop(seen.GetName())
        assert seen.IsManifoldAndOriented()
        box = seen.GetOutbox()
        assert np.allclose(box.MinCoordinate, part.vertices.min(axis=0), atol=1e-4)
        assert np.allclose(box.MaxCoordinate, part.vertices.max(axis=0), atol=1e-4)
    assert not expected
