"""What is kept of compiled kernels."""

import pickle

from articugen.core import compiling


def test_what_is_kept_of_modules_that_moved_is_dropped(tmp_path, monkeypatch):
    kept = tmp_path / "__pycache__"
    kept.mkdir()
    (kept / "sound.nbi").write_bytes(pickle.dumps("1.0") + pickle.dumps((("stamp", 1), {})))
    (kept / "moved.nbi").write_bytes(pickle.dumps("1.0") + b"carticugen.no_such\nBvh\n.")
    (kept / "cut.nbi").write_bytes(pickle.dumps("1.0"))
    (kept / "moved.nbc").write_bytes(b"code")
    monkeypatch.setattr(compiling, "_with_kernels", lambda: [tmp_path / "kernels.py"])
    compiling._drop_unreadable()
    assert {path.name for path in kept.iterdir()} == {"sound.nbi", "moved.nbc"}
