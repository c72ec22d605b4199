"""What people type wrongly: each answer in at most four lines that name the remedy, with the exit code of its kind."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from tests.test_files_shard import RIG, write
from tofcapture.cli import main
from tofcapture.rig import dumps_rig

# command line | exit code | what the answer says, as a pattern
USES = """
nonsense                                        | 2 | no command 'nonsense'.*--help
trian data                                      | 2 | 'trian'.*try: train instead
biuld-dataset rec --out x                       | 2 | 'biuld-dataset'.*try: build-dataset instead
record                                          | 2 | required: --out.*try: tofcapture record --help
record --scen mug                               | 2 | --scen .*try: --scene instead
record --scene mug --out x --frame=3            | 2 | --frame .*try: --frames instead
record --scene mug --out x --views ten          | 2 | --views: expected a whole number, got 'ten'
record --scene mug --out x --views 0            | 3 | at least 1, got 0.*try: tofcapture record --help
record --scene mug --out x --frames 0           | 3 | at least 1, got 0
record --scene mug --out x --turns 0            | 3 | 1 to 36, got 0
record --scene mug --calibration --out x        | 2 | --calibration: not allowed with
record --scene ../up --out x                    | 3 | '../up'.*try: .*--scene mug-2
record --scene mug --out notes.txt              | 3 | notes.txt.*expected a folder.*try: name another
record --scene mug --out x --station none.toml  | 3 | none.toml.*try: leave --station out
record --scene mug --out x --station cut.toml   | 3 | cut.toml.*Expected ']'
record --scene mug --out x --station more.toml  | 3 | tables arm, .*got tofu.*try: compare with
record --scene mug --out x --retake 99          | 3 | a view from 0 to 24, got 99
simulate none.toml --out x.h5                   | 3 | cannot read the world.*try:
simulate cut.toml --out x.h5                    | 3 | not TOML.*try:
simulate-dataset --scenes 0 --out x             | 3 | at least 1, got 0.*try:
simulate-dataset --scenes 3 --suite in --out x  | 3 | one of tof100, indoor.*got 'in'
simulate-dataset --scenes 3 --kinds cup --out x | 3 | some of object, .*got cup
import none --out x                             | 5 | none: no such file or folder
import empty --out x                            | 5 | found an empty folder.*try: .*np.save
import mug.h5                                   | 3 | expected --out.*try: tofcapture import mug.h5 --out
import raw.npy --out x                          | 3 | missing \\[tof\\] fx.*try: --camera fx,fy,cx,cy
import raw.npy --out x --camera 190             | 3 | at least fx,fy,cx,cy.*try: .*in pixels
align none                                      | 5 | views of the board.*got nothing.*try: .*--calibration
align data                                      | 5 | views of the board.*got a dataset
align rec --metod joint                         | 2 | --metod .*try: --method instead
align rec --backend gicp                        | 3 | small-gicp, got 'gicp'
build-dataset none --out x                      | 5 | a recording.*got nothing.*try: tofcapture record
build-dataset data --out x                      | 5 | a recording.*got a dataset
build-dataset rec --out x --scales 3            | 2 | one of 1, 2, 4, got '3'
build-dataset rec --out x --part 5/3            | 3 | 1 <= I <= N, got 5/3.*try: --part 2/8
build-dataset rec --out x --crop-radius -1      | 3 | a positive number, got -1
calibrate hand-ey pairs.json                    | 2 | 'hand-ey'.*try: hand-eye instead
calibrate hand-eye none.json                    | 5 | none.json: no such file
calibrate hand-eye pairs.json                   | 5 | names such as hand and target.*try: known names
calibrate board --board nonsense                | 3 | cannot read the board.*try: packaged boards: aprilgrid
calibrate phase-order raw.npy --mhz fast        | 2 | numbers such as 20,100, got 'fast'
rig show notes.txt                              | 3 | notes.txt: no camera in it.*try: rig.toml
check none                                      | 5 | none.*try:
stats rec/views/mug/view-000.h5                 | 5 | a dataset.*got a view file.*try: .*build-dataset
view notes.txt                                  | 5 | nothing that can be shown.*try: give a recording
view mug.h5 --png x.txt                         | 2 | ends in .png, got x.txt.*try: --png x.png
view mm.toml --png x.png                        | 3 | expected units = "m", got 'mm'
figure dept mug.h5 --out x.png                  | 2 | 'dept'.*try: depth instead
figure depth mug.h5 --out x.bmp                 | 2 | .png, .pdf or .svg.*try: --out figure.png
figure depth mug.h5 --scene cup --out x.png     | 5 | no scene cup.*try: it has mug
pack run --out x                                | 5 | a dataset.*got the folder of a run
export-dataset mug.h5 --format plyy --out x     | 2 | 'plyy'.*try: ply instead
train data/shards/mug.h5 --out x                | 5 | a dataset.*got a shard
train data --out x --preset papr                | 2 | 'papr'.*try: paper instead
train data --out x --minutes -1                 | 2 | a number > 0, got -1
evaluate rec                                    | 5 | a dataset.*got a recording.*try: .*build-dataset
evaluate notes.txt                              | 5 | a dataset.*got a file .txt
evaluate data --split tset                      | 2 | 'tset'.*try: test instead
predict none.h5                                 | 5 | none.h5: no such file.*try: a view file or a shard
predict raw.npy --averge                        | 2 | --averge .*try: --average instead
predict raw.npy --weights none                  | 5 | cannot read the checkpoint.*try: tofcapture train
predict raw.npy --saturation many               | 2 | expected a number > 0, got 'many'
predict raw.npy --device gpu                    | 3 | --device gpu: .*try: --device cpu
report                                          | 3 | nothing to report.*try: --dataset DIR --results
report --dataset none                           | 5 | none.*no such file.*try:
completion powershell                           | 2 | one of bash, .*got 'powershell'
--verson                                        | 2 | got '--verson'.*try: --version instead
doctor lab.toml                                 | 2 | nothing is expected .*got 'lab.toml'.*try: tofcapture doctor --help
record --scene mug --out x --allow-motion yes   | 2 | got 'yes'.*try: tofcapture record --help
record mug --out x                              | 2 | --scene --calibration is required.*try: tofcapture record
record --scene "my mug" --out x                 | 3 | 'my mug'.*try: for example: --scene mug-2
import rec --out x                              | 5 | view-000.h5.*try:
align mug.h5                                    | 5 | views of the board.*got a file .h5.*try: .*--out RECORDING
calibrate coverage empty                        | 5 | views of the board.*got another folder.*try: .*--calibration
build-dataset rec/views/mug --out x             | 5 | got one scene of the recording rec
build-dataset rec --out rec                     | 3 | a folder of its own, got a recording.*try: --out dataset
check empty                                     | 5 | neither.*try: give its own folder
stats data --html x.html extra                  | 2 | got 'extra'.*try: tofcapture stats --help
view data --scene mug                           | 2 | no option --scene .*try: tofcapture view --help
view data --views 0                             | 2 | 1 or more, got 0
figure acquisition data --out x.png             | 5 | a recording with views.*try: tofcapture record
export-dataset data --format hf --out x         | 2 | ply, .*huggingface, got 'hf'
train data --out x --lr 0.1                     | 2 | no option --lr .*try: tofcapture train --help
train rec --out x                               | 5 | a dataset.*got a recording.*try: .*build-dataset
evaluate mug.h5                                 | 5 | a dataset.*got a file .h5.*try: .*build-dataset
predict empty --out x                           | 5 | views, shards or arrays, found none.*try: a recording
predict mug.h5 --view 99                        | 3 | a view of 0 to .*got 99
export --out m.txt                              | 3 | ends in .onnx, got .txt.*try: --format onnx
report --results pairs.json                     | 5 | results version 2, got other JSON.*try: tofcapture evaluate
report --results notes.txt                      | 5 | not JSON.*try: tofcapture evaluate
demo --out notes.txt                            | 3 | notes.txt: expected a folder.*try: name another folder
daemon --root notes.txt                         | 3 | notes.txt: expected a folder.*try: name another
daemon --root empty --http 0.0.0.0:80           | 2 | a loopback address.*try: from another machine: ssh -L
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """One of each thing that a path may lead to; what is not looked into is empty."""
    root = tmp_path_factory.mktemp("wrong")
    files = {
        "notes.txt": "",
        "cut.toml": "[arm\n",
        "pairs.json": "{}",
        "data/shards/mug.h5": "",
        "data/manifest.json": "",
    }
    files |= {
        "rec/views/mug/view-000.h5": "",
        "run/model.safetensors": "",
        "more.toml": "[arm]\ndriver='sim'\n[tofu]\n",
    }
    files["mm.toml"] = dumps_rig(RIG).replace('units = "m"', 'units = "mm"')
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    (root / "empty").mkdir()
    np.save(root / "raw.npy", np.ones((8, 180, 240), np.uint16))
    write(root / "mug.h5")
    return root


@pytest.mark.parametrize("use", USES.strip().splitlines(), ids=lambda use: use.partition("|")[0].strip())
def test_a_wrong_use_is_answered_with_its_remedy(use, folder, capsys, monkeypatch):
    """The exit code tells the kind, stdout or stderr what was wrong and what to try; nothing is written."""
    line, code, said = (part.strip() for part in use.split("|"))
    monkeypatch.chdir(folder)
    before = sorted(p for p in Path().rglob("*") if p.is_file())
    assert main(shlex.split(line)) == int(code)
    told = capsys.readouterr()
    answer = [x for x in (told.err + told.out).splitlines() if not re.match(r"[\w ]+, \d+ s$", x)]  # progress
    assert len(answer) <= 4, answer
    assert "Traceback" not in "".join(answer)
    assert re.search(said, "  ".join(answer)), answer
    assert any(x.startswith("  try: ") for x in answer), answer
    assert sorted(p for p in Path().rglob("*") if p.is_file()) == before
