"""Whatever is wrong with a survey's files: one line and status 2, or a run; nothing else.

SASMAP_MUTATIONS sets how many are tried (60; 2100 were for the record).
"""

import os
import shutil
import socket
import threading
import time

import pytest

from sasmap.cli import main
from tests.helpers import small_survey
from tests.mutations import mutate

COUNT = int(os.environ.get("SASMAP_MUTATIONS", "60"))


@pytest.fixture(scope="module")
def template(tmp_path_factory):
    """A small survey that has been run."""
    folder = tmp_path_factory.mktemp("template")
    path = small_survey(folder, sediments={})
    assert main(["run", str(path), "--quiet"]) == 0
    return folder


@pytest.fixture(scope="module")
def connections():
    """Connections that anything makes over HTTP: all proxies lead to a listener that counts."""
    found = []
    listener = socket.create_server(("127.0.0.1", 0))

    def listen():
        while True:
            try:
                connection, _ = listener.accept()
            except OSError:
                return
            found.append(connection.recv(200))
            connection.close()

    threading.Thread(target=listen, daemon=True).start()
    proxy = f"http://127.0.0.1:{listener.getsockname()[1]}"
    names = ("http_proxy", "https_proxy", "HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY")
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(dict.fromkeys(names, proxy))
    yield found
    for name, value in before.items():
        os.environ.pop(name) if value is None else os.environ.update({name: value})
    listener.close()


def contents(folder):
    return {p.name: p.read_bytes() for p in folder.iterdir() if p.is_file()}


@pytest.mark.parametrize("block", range(10))
def test_mutated_inputs_end_in_a_run_or_a_line(template, tmp_path, capfd, connections, block):
    before = contents(template / "out")
    for seed in range(block, COUNT, 10):
        folder = tmp_path / str(seed)
        shutil.copytree(template, folder)
        changed = mutate(folder, seed)
        start = time.monotonic()
        status = main(["run", str(folder / "survey.yaml"), "--quiet"])
        assert time.monotonic() - start < 300, seed  # none may hang, compilation included
        said = capfd.readouterr()
        assert status in (0, 1, 2), seed
        assert "Traceback" not in said.err, seed
        if status == 2:
            lines = said.err.splitlines()
            assert lines, seed
            assert all(line.startswith("sasmap: ") for line in lines), (seed, lines)
            named = (changed.name, "survey.yaml", folder.name, "/dev", "/proc", "sasmap: /: ")
            assert all(any(n in line for n in named) for line in lines), (seed, lines)
            assert contents(folder / "out") == before, seed
        shutil.rmtree(folder)
    assert connections == []
