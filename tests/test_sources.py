"""Sources and actions of real devices, against a demo camera, a folder, and loopbacks."""

import threading
import time
from http.server import BaseHTTPRequestHandler, HTTPServer

import numpy as np
import pytest
import tifffile

from gdptlab.live import FillingFolder, MicroManagerCamera, over_http, over_serial


def test_a_folder_that_fills(tmp_path):
    tifffile.imwrite(tmp_path / "000.tif", np.zeros((4, 5), np.uint16))  # there already: not read
    source = FillingFolder(tmp_path, patience_s=0.3)

    def fill():
        for k in (1, 2):
            tifffile.imwrite(tmp_path / f"00{k}.tif", np.full((4, 5), k, np.uint16))
        whole = (tmp_path / "002.tif").read_bytes()
        (tmp_path / "notes.txt").write_text("no image")
        with (tmp_path / "003.tif").open("wb") as file:  # written slowly
            for part in (whole[:20], whole[20:]):
                file.write(part)
                file.flush()
                time.sleep(0.0005)

    writer = threading.Thread(target=fill)
    writer.start()
    shown = list(iter(source.grab, None))
    writer.join()
    assert [frame.image[0, 0] for frame in shown] == [1, 2, 2]
    assert (np.diff([frame.t_s for frame in shown]) > 0).all()
    with pytest.raises(FileNotFoundError, match="folder"):
        FillingFolder(tmp_path / "none")


def test_the_demo_camera_of_micro_manager():
    mm = pytest.importorskip("pymmcore_plus", reason="the extra `camera` is not installed")
    if mm.find_micromanager() is None:
        pytest.skip("no Micro-Manager: pip install mm-test-adapters")
    core = mm.CMMCorePlus()
    core.loadSystemConfiguration()
    core.setExposure(5)
    camera = MicroManagerCamera(core)
    frames = [camera.grab() for _ in range(4)]
    core.stopSequenceAcquisition()
    while (frame := camera.grab()) is not None:  # what is in the memory still comes
        frames.append(frame)
    assert {frame.image.shape for frame in frames} == {(core.getImageHeight(), core.getImageWidth())}
    assert (np.diff([frame.t_s for frame in frames]) > 0).all()
    core.unloadAllDevices()
    with pytest.raises(TypeError, match="core"):
        MicroManagerCamera(3)


def test_a_serial_port():
    pytest.importorskip("serial", reason="the extra `camera` is not installed")
    off = over_serial("loop://", b"OUTPUT OFF\n", b"OUTPUT OFF\n")  # a loop echoes what it is told
    assert off("a result") is None and off() is None
    with pytest.raises(TimeoutError, match="OUTPUT OFF"):
        over_serial("loop://", b"OUTPUT OFF\n", b"OUTPUT IS OFF\n", timeout_s=0.05)()
    with pytest.raises(OSError, match="answered b'NO'"):
        over_serial("loop://", b"NO", b"OK")()
    with pytest.raises(TypeError, match="command"):
        over_serial("loop://", "off", b"OK")


@pytest.fixture
def server():
    asked = []

    class Device(BaseHTTPRequestHandler):
        def do_POST(self):
            asked.append(self.rfile.read(int(self.headers["Content-Length"])))
            if self.path == "/slow":
                time.sleep(0.3)
            self.send_response(500 if self.path == "/broken" else 204)
            self.end_headers()

        def log_message(self, *_):
            pass

    with HTTPServer(("127.0.0.1", 0), Device) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}", asked
        server.shutdown()
        thread.join()


def test_an_address(server):
    url, asked = server
    over_http(url, data=b"off", timeout_s=5)("a result")
    assert asked == [b"off"]
    with pytest.raises(OSError, match="500"):
        over_http(url + "/broken", data=b"off", timeout_s=5)()
    with pytest.raises(OSError, match="timed out"):
        over_http(url + "/slow", data=b"off", timeout_s=0.05)()
    for bad, kind in {"file:///etc/passwd": ValueError, 3: TypeError}.items():
        with pytest.raises(kind, match="url"):
            over_http(bad)
    with pytest.raises(TypeError, match="data"):
        over_http(url, data="off")
