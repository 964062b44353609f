"""Where the compiled inner loops are kept, and what is said while they are compiled."""

import os
import sys
import time

from disctrack import cli
from disctrack.progress import compiling


def test_a_read_only_home_and_installation_get_a_cache_of_their_own(monkeypatch, tmp_path, capsys):
    monkeypatch.delitem(sys.modules, "numba", raising=False)
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")  # so that it is as before after the test
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    cli._keep_compiled_loops_somewhere()
    assert "NUMBA_CACHE_DIR" not in os.environ  # this checkout can be written to
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    cli._keep_compiled_loops_somewhere()
    folder = os.environ["NUMBA_CACHE_DIR"]
    assert os.path.isdir(folder)
    assert folder.startswith(str(tmp_path))
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1
    assert folder in said[0]


def test_compiling_is_announced_and_loading_is_not(capsys):
    with compiling("corners", 8):
        pass
    assert capsys.readouterr().err == ""
    with compiling("corners", 8):
        time.sleep(1.2)
    assert "compiling the inner loops of corners: once per installation, about 8 s" in capsys.readouterr().err
