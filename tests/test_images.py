"""Images come out of files as they went in, in the right order, and only when they are asked for."""

import os
import pickle

import numpy as np
import pandas as pd
import pytest
import tifffile

from gdptlab import batch
from gdptlab.pipeline.images import Images, open_images, open_scan

FILM = np.random.default_rng(1).integers(0, 200, (12, 9, 14), dtype=np.uint8)


def write(path, images, **options):
    tifffile.imwrite(path, images, **{"photometric": "minisblack"} | options)
    return path


def assert_holds(images, expected):
    assert isinstance(images, Images)
    assert images.shape == expected.shape and images.dtype == expected.dtype
    read = np.asarray(images)
    assert read.dtype == expected.dtype
    np.testing.assert_array_equal(read, expected)


@pytest.mark.parametrize("shape", [(9, 14), (1, 9, 14), (5, 9, 14), (3, 9, 14)])
@pytest.mark.parametrize("dtype", ["u1", "u2", ">u2", "f4", "f8", "i2", "u4"])
@pytest.mark.parametrize("compression", [None, "zlib", "lzw"])
def test_images_come_back_as_they_were(tmp_path, shape, dtype, compression):
    images = (np.random.default_rng(1).random(shape) * 200).astype(dtype)
    order = ">" if dtype[0] == ">" else None
    path = write(tmp_path / "a.tif", images, compression=compression, byteorder=order)
    expected = images.reshape(-1, 9, 14).astype(images.dtype.newbyteorder("="))
    assert_holds(open_images(str(path)), expected)
    assert_holds(open_images(path)[1:4], expected[1:4])
    np.testing.assert_array_equal(open_images(path)[-1], expected[-1])


def in_a_loop(path):
    with tifffile.TiffWriter(path) as file:
        for image in FILM:
            file.write(image, photometric="minisblack")


def pages(path):
    with tifffile.TiffWriter(path) as file:
        for image in FILM:
            file.write(image, photometric="minisblack", metadata=None)


KINDS = {
    "one by one": in_a_loop,
    "pages": pages,
    "ImageJ": lambda path: write(path, FILM, imagej=True, photometric=None),
    "ImageJ beyond 4 GB": lambda path: write(path, FILM, imagej=True, photometric=None, truncate=True),
    "big": lambda path: write(path, FILM, bigtiff=True),
    "tiles": lambda path: write(path, FILM, tile=(16, 16), compression="zlib"),
    "predictor": lambda path: write(path, FILM, predictor=True, compression="zlib"),
    "inverted": lambda path: write(path, FILM, photometric="miniswhite"),
}


@pytest.mark.parametrize("kind", KINDS)
def test_any_kind_of_tiff(tmp_path, kind):
    path = tmp_path / "a.tif"
    KINDS[kind](path)
    assert_holds(open_images(path), FILM)
    assert_holds(open_images(path)[[7, 2]], FILM[[7, 2]])


def test_packed_12_bit(tmp_path):
    """As some cameras save them: two pixels in three bytes."""
    images = np.random.default_rng(2).integers(0, 4096, (3, 8, 10), dtype=np.uint16)
    path = write(tmp_path / "a.tif", images, bitspersample=12)
    assert_holds(open_images(path), images)


@pytest.mark.parametrize("axes", ["TYX", "ZYX"])
def test_ome(tmp_path, axes):
    metadata = {"axes": axes, "PhysicalSizeX": 650.0, "PhysicalSizeXUnit": "nm", "PhysicalSizeY": 0.65}
    path = write(tmp_path / "a.ome.tif", FILM, metadata=metadata)
    assert_holds(open_images(path), FILM)
    assert open_images(path).um_per_px == open_images(path)[2:4].um_per_px == pytest.approx(0.65)


def ome_set(folder):
    """A film in two OME-TIFFs that know of each other."""
    ids = "urn:uuid:00000000-0000-0000-0000-00000000000"
    planes = "".join(
        f'<TiffData FirstT="{t}" IFD="{t % 6}" PlaneCount="1"><UUID FileName="f{t // 6}.ome.tif">{ids}{t // 6}</UUID>'
        "</TiffData>"
        for t in range(12)
    )
    for k in range(2):
        xml = (
            f'<OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06" UUID="{ids}{k}"><Image ID="Image:0">'
            '<Pixels ID="Pixels:0" DimensionOrder="XYZCT" Type="uint8" SizeX="14" SizeY="9" SizeZ="1" SizeC="1" '
            f'SizeT="12">{planes}</Pixels></Image></OME>'
        )
        write(folder / f"f{k}.ome.tif", FILM[6 * k : 6 * k + 6], description=xml, metadata=None)


def test_ome_of_several_files(tmp_path):
    ome_set(tmp_path)
    assert_holds(open_images(tmp_path / "f0.ome.tif"), FILM)
    assert_holds(open_images(tmp_path), FILM)
    assert open_images(tmp_path)[[5, 6]].names == ["f0.ome.tif", "f1.ome.tif"]
    (tmp_path / "f1.ome.tif").unlink()
    with pytest.raises((ValueError, FileNotFoundError)):
        np.asarray(open_images(tmp_path / "f0.ome.tif"))


def test_um_per_px_of_imagej(tmp_path):
    path = write(
        tmp_path / "a.tif", FILM, imagej=True, photometric=None, resolution=(1 / 0.325,) * 2, metadata={"unit": "um"}
    )
    assert open_images(path).um_per_px == pytest.approx(0.325)
    assert open_images(write(tmp_path / "b.tif", FILM, resolution=(72, 72))).um_per_px is None


# -------------------- folders


def test_folder_in_natural_order(tmp_path):
    for k, image in enumerate(FILM):
        write(tmp_path / f"Frame{k}.{'TIF' if k % 2 else 'tiff'}", image)
    (tmp_path / "notes.txt").write_text("not an image")
    (tmp_path / ".hidden.tif").write_text("nor this")
    images = open_images(tmp_path)
    assert_holds(images, FILM)
    assert images.names[:3] == ["Frame0.tiff", "Frame1.TIF", "Frame2.tiff"]


def test_folder_of_stacks(tmp_path):
    for k in range(3):
        write(tmp_path / f"part{10 * k}.tif", FILM[4 * k : 4 * k + 4], compression="zlib" if k == 1 else None)
    assert_holds(open_images(tmp_path), FILM)


def test_pattern(tmp_path):
    for k in range(3):
        write(tmp_path / f"{k}_green.tif", FILM[k])
        write(tmp_path / f"{k}_red.tif", FILM[k + 3])
    assert_holds(open_images(tmp_path / "*_red.tif"), FILM[3:6])


def test_a_folder_is_not_read_before_it_is_asked_for(tmp_path):
    for k in range(3):
        write(tmp_path / f"{k}.tif", FILM[k])
    (tmp_path / "7.tif").write_text("damaged")
    images = open_images(tmp_path)
    assert len(images) == 4
    assert_holds(images[:3], FILM[:3])
    with pytest.raises(ValueError, match=r"^path: got '7.tif'"):
        images[3]


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (FILM[0, :8], "'2.tif'"),
        (FILM[0].astype(np.uint16), "'2.tif'"),
        (FILM[:2], "'2.tif'"),
    ],
)
def test_files_that_differ(tmp_path, other, message):
    write(tmp_path / "1.tif", FILM[0])
    write(tmp_path / "2.tif", other)
    with pytest.raises(ValueError, match=f"^path: got {message}"):
        np.asarray(open_images(tmp_path))


def test_stacks_that_differ(tmp_path):
    write(tmp_path / "1.tif", FILM)
    write(tmp_path / "2.tif", FILM[:, :8])
    with pytest.raises(ValueError, match=r"^path: got '2.tif'"):
        open_images(tmp_path)


def test_signs_and_decimals_in_names_are_part_of_the_number(tmp_path):
    for k, z in enumerate((-50, -7.5, 0, 2, 10)):
        write(tmp_path / f"z_{z}.tif", FILM[k])
    assert_holds(open_images(tmp_path), FILM[:5])


def test_a_hyphen_is_no_sign(tmp_path):
    for k in range(12):
        write(tmp_path / f"frame-{k}.tif", FILM[k])
    assert_holds(open_images(tmp_path), FILM)


def test_images_stay_those_that_were_opened(tmp_path, monkeypatch):
    for name, film in (("one", FILM), ("other", FILM[::-1].copy())):
        (tmp_path / name).mkdir()
        write(tmp_path / name / "a.tif", film)
    monkeypatch.chdir(tmp_path / "one")
    images = open_images("a.tif")
    monkeypatch.chdir(tmp_path / "other")
    assert_holds(images, FILM)
    assert images.paths == [tmp_path / "one" / "a.tif"]


@pytest.mark.parametrize("compression", [None, "zlib"])
def test_a_file_that_was_replaced_is_refused(tmp_path, compression):
    path = write(tmp_path / "a.tif", FILM, compression=compression)
    images = open_images(path)
    write(path, FILM[:, ::-1].copy(), compression=compression, description="x" * 100)
    with pytest.raises(ValueError, match=r"^path: got 'a.tif'.*changed"):
        images[0]


def test_an_ome_file_does_not_lead_out_of_its_folder(tmp_path):
    (tmp_path / "inner").mkdir()
    ome_set(tmp_path / "inner")
    text = (tmp_path / "inner" / "f0.ome.tif").read_bytes()
    assert text.count(b"f1.ome.tif") == 6
    for name in (b"../a.ome.t", b"/a/.ome.ti"):
        (tmp_path / "inner" / "f0.ome.tif").write_bytes(text.replace(b"f1.ome.tif", name))
        with pytest.raises(ValueError, match=r"^path: got 'f0.ome.tif'.*folder"):
            open_images(tmp_path / "inner" / "f0.ome.tif")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with names here")
def test_a_pipe_is_refused_and_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "a.tif")
    with pytest.raises(ValueError, match=r"^path: .*a.tif"):
        open_images(tmp_path / "a.tif")
    with pytest.raises(FileNotFoundError):
        open_images(tmp_path)


def test_time_to_open_grows_with_the_number_of_files_not_its_square(tmp_path, monkeypatch):
    for k in range(40):
        write(tmp_path / f"{k}.tif", FILM[:2])
    compared = []
    monkeypatch.setattr(type(tmp_path), "__eq__", lambda a, b: compared.append(1) or str(a) == str(b), raising=False)
    monkeypatch.setattr(type(tmp_path), "__hash__", lambda a: hash(str(a)), raising=False)
    assert len(open_images(tmp_path)) == 80
    assert len(compared) < 40 * 10


# -------------------- a sequence


def test_sequence(tmp_path):
    images = open_images(write(tmp_path / "a.tif", FILM))
    assert len(images) == 12 and images.shape == (12, 9, 14)
    np.testing.assert_array_equal(np.stack(list(images)), FILM)
    for index in (slice(2, 9, 3), slice(None, None, -1), [3, 1, 1], np.arange(12) % 3 == 0, slice(0, 0)):
        assert_holds(images[index], FILM[index])
    np.testing.assert_array_equal(images[-2], FILM[-2])
    np.testing.assert_array_equal(np.asarray(images, np.float32), FILM.astype(np.float32))
    with pytest.raises(IndexError):
        images[12]
    with pytest.raises(TypeError, match=r"^index: got"):
        images[0, 3]
    with pytest.raises(ValueError, match=r"^copy: got False"):
        np.asarray(images, copy=False)
    assert repr(images) == "<12 images of 9 by 14 px, uint8, in 1 files>"


def test_other_processes_get_names_and_no_pixels(tmp_path):
    write(tmp_path / "a.tif", np.zeros((40, 300, 300)), compression="zlib")
    images = open_images(tmp_path / "a.tif")
    list(zip(range(3), images, strict=False))  # in the middle of reading
    sent = pickle.dumps(images)
    assert len(sent) < 3000
    assert_holds(pickle.loads(sent), np.zeros((40, 300, 300)))


def test_a_slice_knows_only_its_own_files(tmp_path):
    for k in range(12):
        write(tmp_path / f"{k}.tif", FILM[k])
    assert len(pickle.dumps(open_images(tmp_path)[3:5])) < len(pickle.dumps(open_images(tmp_path))) - 200


# -------------------- what is refused


def test_no_such_image(tmp_path):
    for path in (tmp_path / "absent.tif", tmp_path, tmp_path / "*.tif", tmp_path / "absent" / "*.tif"):
        with pytest.raises(FileNotFoundError):
            open_images(path)


@pytest.mark.parametrize("path", [None, 3, FILM, [FILM]])
def test_no_path(path):
    with pytest.raises(TypeError, match=r"^path: got a"):
        open_images(path)


@pytest.mark.parametrize("content", [b"", b"II*", b"not a tiff, though named so", bytes(1000)])
def test_not_a_tiff(tmp_path, content):
    path = tmp_path / "a.tif"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"^path: got 'a.tif'"):
        open_images(path)


@pytest.mark.parametrize("compression", [None, "zlib"])
@pytest.mark.parametrize("fraction", [0.05, 0.3, 0.7, 0.99])
def test_truncated_tiff(tmp_path, compression, fraction):
    path = tmp_path / "a.tif"
    images = np.random.default_rng(1).integers(0, 4000, (6, 40, 50), np.uint16)
    whole = write(path, images, compression=compression).read_bytes()
    path.write_bytes(whole[: int(fraction * len(whole))])
    with pytest.raises(ValueError, match=r"^path: got 'a.tif'"):
        np.asarray(open_images(path))


@pytest.mark.parametrize("shape", [(20, 30, 3), (1, 20, 30, 3), (3, 20, 30, 3), (20, 30, 4), (4, 3, 20, 30)])
def test_colour_is_refused_with_advice(tmp_path, shape):
    path = write(
        tmp_path / "a.tif",
        np.zeros(shape, np.uint8),
        photometric="rgb",
        planarconfig="separate" if shape[1] == 3 else "contig",
    )
    with pytest.raises(ValueError, match=r"^path: got 'a.tif'"):
        open_images(path)


@pytest.mark.parametrize(("axes", "expected"), [("TCYX", FILM[1::2]), ("CZYX", FILM[6:])])
@pytest.mark.parametrize("compression", [None, "zlib"])
def test_a_channel_is_chosen(tmp_path, axes, expected, compression):
    shape = (6, 2, 9, 14) if axes == "TCYX" else (2, 6, 9, 14)
    path = write(tmp_path / "a.ome.tif", FILM.reshape(shape), metadata={"axes": axes}, compression=compression)
    assert_holds(open_images(path, channel=1), expected)
    for channel in (None, 2):
        with pytest.raises(ValueError, match=r"^(path|channel): .*\b0 to 1\b"):
            open_images(path, channel=channel)


def test_a_channel_of_imagej_is_chosen(tmp_path):
    path = write(
        tmp_path / "a.tif", FILM.reshape(6, 2, 9, 14), imagej=True, photometric=None, metadata={"axes": "TCYX"}
    )
    assert_holds(open_images(path, channel=0), FILM[::2])
    scan, _ = open_scan(path, start_um=5, step_um=-1, channel=0)
    assert_holds(scan, FILM[::2][::-1])
    with pytest.raises(ValueError, match=r"^path: got 'a.tif'"):
        open_images(path)


def test_a_position_is_chosen(tmp_path):
    """Positions on a slide, recorded one after the other, are no film."""
    with tifffile.TiffWriter(tmp_path / "a.ome.tif", ome=True) as file:
        for part in (FILM[:5], FILM[5:10]):
            file.write(part, photometric="minisblack", metadata={"axes": "TYX"})
    assert_holds(open_images(tmp_path / "a.ome.tif", position=1), FILM[5:10])
    for position in (None, 2):
        with pytest.raises(ValueError, match=r"^(path|position): .*\b0 to 1\b"):
            open_images(tmp_path / "a.ome.tif", position=position)
    with pytest.raises(ValueError, match=r"^position: "):
        open_images(write(tmp_path / "b.tif", FILM), position=1)


def test_several_axes_are_refused(tmp_path):
    path = write(tmp_path / "a.ome.tif", FILM.reshape(6, 2, 9, 14), metadata={"axes": "TZYX"})
    with pytest.raises(ValueError, match=r"^path: got 'a.ome.tif' .*TZYX"):
        open_images(path)


def test_images_of_several_sizes_are_refused(tmp_path):
    path = tmp_path / "a.tif"
    with tifffile.TiffWriter(path) as file:
        for n in (20, 21):
            file.write(np.zeros((n, 30), np.uint8), photometric="minisblack")
    with pytest.raises(ValueError, match=r"^path: got 'a.tif'"):
        open_images(path)


def test_complex_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"^path: got 'a.tif' .*complex64"):
        open_images(write(tmp_path / "a.tif", np.zeros((4, 9, 14), np.complex64)))


# -------------------- scans


def test_depths_from_start_and_step(tmp_path):
    path = write(tmp_path / "a.tif", FILM)
    images, z_um = open_scan(path, start_um=-5, step_um=0.5)
    np.testing.assert_allclose(z_um, np.arange(-5, 1, 0.5))
    assert_holds(images, FILM)
    images, z_um = open_scan(path, start_um=5, step_um=-2)
    np.testing.assert_allclose(z_um, np.arange(-17, 6, 2))
    assert_holds(images, FILM[::-1])


def test_depths_from_a_table(tmp_path):
    path = write(tmp_path / "a.tif", FILM[:4])
    pd.DataFrame({"image": range(4), "z_um": [3.5, -1, 0.25, 9]}).to_csv(tmp_path / "z.csv")
    images, z_um = open_scan(path, csv=tmp_path / "z.csv")
    assert z_um.tolist() == [-1, 0.25, 3.5, 9]
    assert_holds(images, FILM[[1, 2, 0, 3]])


@pytest.mark.parametrize(
    "form", ["z{:g}.tif", "2023-11-05_z_{:g}um_ch1.tif", "{:+.2f}.tif", "scan z={:.1f} exp10ms.tiff"]
)
def test_depths_from_names(tmp_path, form):
    depths = [10, -10, 0, 2.5, -2.5, 100]
    for z, image in zip(depths, FILM, strict=False):
        write(tmp_path / form.format(z), image)
    images, z_um = open_scan(tmp_path)
    assert z_um.tolist() == sorted(depths)
    assert_holds(images, FILM[np.argsort(depths)])


@pytest.mark.parametrize(
    ("names", "depths"),
    [
        (["z1e+01", "z0e+00", "z-5e+00"], [10, 0, -5]),
        (["z_-2,5um", "z_0um", "z_2,5um"], [-2.5, 0, 2.5]),
        (["bead 1500nm", "bead 500nm"], [1.5, 0.5]),
        (["s_1µm", "s_2μm"], [1, 2]),
        (["a0.01mm", "a0.02mm"], [10, 20]),
        (["1.5", "2", "10"], [1.5, 2, 10]),
    ],
)
def test_depths_from_names_with_units_commas_and_exponents(tmp_path, names, depths):
    for name, image in zip(names, FILM, strict=False):
        write(tmp_path / f"{name}.tif", image)
    images, z_um = open_scan(tmp_path)
    np.testing.assert_allclose(z_um, sorted(depths))
    assert_holds(images, FILM[np.argsort(depths)])


def test_depths_from_a_table_with_decimal_commas(tmp_path):
    path = write(tmp_path / "a.tif", FILM[:3])
    (tmp_path / "z.csv").write_text("\ufeffimage;z_um\n0;1,5\n1;-2,5\n2;0\n", encoding="utf-8")
    assert open_scan(path, csv=tmp_path / "z.csv")[1].tolist() == [-2.5, 0, 1.5]


def test_depths_from_names_by_a_pattern(tmp_path):
    for k, z in enumerate((-30, -20, -10)):
        write(tmp_path / f"{3 - k}-z{z}.tif", FILM[k])
    images, z_um = open_scan(tmp_path, names=r"z(-?\d+)")
    assert z_um.tolist() == [-30, -20, -10]
    assert_holds(images, FILM[:3])


@pytest.mark.parametrize(
    ("files", "arguments", "message"),
    [
        (["a"], {}, "^path: .*'a'"),
        (["1_2", "2_3"], {}, "^path: .*'1_2'"),
        (["1", "2_3"], {}, "^path: .*'1'"),
        (["z-1", "z-2"], {}, "^path: .*'z-1'"),
        (["frame1", "frame2"], {}, "^path: .*'frame1'"),
        (["z1um", "z2"], {}, "^path: .*'z1um'"),
        (["z1", "z01", "z2"], {}, "^path: "),
        (["z1", "z1.0", "z2"], {"names": "z(.*)"}, "^names: "),
        (["z1", "z2"], {"names": "("}, "^names: "),
        (["z1", "z2"], {"names": "y(.)"}, "^names: .*'z1'"),
        (["z1", "z2"], {"names": r"z\d"}, "^names: "),
        (["z1", "zx"], {"names": "z(.)"}, "^names: "),
        (["z1", "z2"], {"start_um": 1}, "^start_um, step_um, csv, names"),
        (["z1", "z2"], {"start_um": 1, "step_um": 2, "names": "(1)"}, "^start_um, step_um, csv, names"),
        (["z1", "z2"], {"start_um": np.nan, "step_um": 2}, "^start_um: "),
        (["z1", "z2"], {"csv": "short.csv"}, "^csv: "),
        (["z1", "z2"], {"csv": "other.csv"}, "^csv: "),
        (["z1", "z2"], {"csv": "empty.csv"}, "^csv: "),
        (["z1", "z2"], {"csv": "nan.csv"}, "^csv: "),
        (["z1", "z2"], {"csv": "commas.csv"}, "^csv: "),
        (["z1", "z2"], {"csv": "twice.csv"}, "^csv: "),
    ],
)
def test_depths_that_are_refused(tmp_path, monkeypatch, files, arguments, message):
    monkeypatch.chdir(tmp_path)
    for name in files:
        write(tmp_path / f"{name}.tif", FILM[0])
    for name, text in {
        "short": "z_um\n1\n",
        "other": "z\n1\n2\n",
        "empty": "",
        "nan": "z_um\nnan\n2\n",
        "commas": "z_um\n1,5\n2,5\n",
        "twice": "z_um\n2\n2\n",
    }.items():
        (tmp_path / f"{name}.csv").write_text(text)
    with pytest.raises(ValueError, match=message):
        open_scan(tmp_path, **arguments)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes with a name are of POSIX")
def test_depths_are_read_from_a_file_alone(tmp_path):
    """A number would be the descriptor of an open file, a pipe would be waited for."""
    for k in range(2):
        write(tmp_path / f"{k}.tif", FILM[0])
    os.mkfifo(tmp_path / "pipe.csv")
    with pytest.raises(TypeError, match=r"^csv: "):
        open_scan(tmp_path, csv=0)
    with pytest.raises(ValueError, match=r"^csv: .*'pipe.csv'"):
        open_scan(tmp_path, csv=tmp_path / "pipe.csv")


# -------------------- measured


@pytest.mark.parametrize("n_jobs", [1, 2])
def test_batch_reads_files_where_they_are_measured(few, calibration, tmp_path, n_jobs):
    frames = np.stack([np.roll(few[0], k, axis=1) for k in range(5)])
    for k, frame in enumerate(frames):
        write(tmp_path / f"{k}.tif", frame)
    measured = batch(open_images(tmp_path), calibration, n_jobs=n_jobs, progress=False)
    pd.testing.assert_frame_equal(measured, batch(frames, calibration, progress=False), check_exact=True)


def test_a_stage_that_stood_still_is_averaged(tmp_path) -> None:
    """Its encoder reads a little more or less."""
    z_um = [-4.01, -3.99, -4.0, -2, 0, 2, 4.02, 3.98]
    scan = np.random.default_rng(5).integers(0, 4000, (8, 9, 11), dtype=np.uint16)
    tifffile.imwrite(tmp_path / "scan.tif", scan, photometric="minisblack")
    pd.DataFrame({"z_um": z_um}).to_csv(tmp_path / "z.csv")
    with pytest.warns(UserWarning, match=r"^csv: the stage stood still at -4 µm in 3 images and at 4.02 µm in 2"):
        images, depths = open_scan(tmp_path / "scan.tif", csv=tmp_path / "z.csv")
    np.testing.assert_allclose(depths, [-4, -2, 0, 2, 4], atol=1e-9)
    np.testing.assert_allclose(images[0], scan[:3].mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(images[-1], scan[6:].mean(axis=0), rtol=1e-6)
    np.testing.assert_array_equal(images[1:-1], scan[3:6])
