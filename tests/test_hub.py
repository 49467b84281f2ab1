"""Experts by hf://: pinned, kept, refused in few words; against a hub on this machine."""

import hashlib
import json
import os
import re
import shutil
import socket
import sys
import time

import numpy as np
import onnx
import pytest
from conftest import QUICK, TOY, mlp_onnx
from hub_stand_in import Repository, stand_in
from shells import shell

import fdtasil
from fdtasil.errors import ExpertError, SettingError
from fdtasil.experts.hub import requests, uri
from fdtasil.experts.load import load_expert

try:
    import huggingface_hub
    from huggingface_hub import constants
except ImportError:
    huggingface_hub = None

pytestmark = pytest.mark.usefixtures("no_pictures")

needs_library = pytest.mark.skipif(huggingface_hub is None, reason="needs fdtasil[hub]")
WALKER = "hf://org/repo/walker.onnx"
LIMIT = 15  # seconds that an error may take


@pytest.fixture
def surroundings(tmp_path, monkeypatch):
    """No token, no proxy, no call home, and a cache of its own; also for child processes."""
    for name in ("HF_TOKEN", "HUGGING_FACE_HUB_TOKEN", "HF_HUB_DOWNLOAD_TIMEOUT"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.setenv("HF_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("HF_ASSETS_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("HF_HUB_DISABLE_TELEMETRY", "1")
    if huggingface_hub is None:
        yield monkeypatch
        return
    # What it read from the variables when it was imported.
    monkeypatch.setattr(constants, "HF_HUB_DISABLE_TELEMETRY", True)
    monkeypatch.setattr(constants, "HF_TOKEN_PATH", str(tmp_path / "no token"))
    huggingface_hub.close_session()
    yield monkeypatch
    huggingface_hub.close_session()


@pytest.fixture
def hub(surroundings, tmp_path):
    """A hub with one repository, whose newest commit holds a model."""
    if huggingface_hub is None:
        pytest.skip("needs fdtasil[hub]")
    with stand_in() as running:
        surroundings.setenv("HF_ENDPOINT", running.endpoint)
        running.repositories["org/repo"] = Repository()
        running.repositories["org/repo"].commit(
            {"walker.onnx": mlp_onnx(tmp_path / "walker.onnx").read_bytes(), "code.py": b"1 / 0"}
        )
        yield running


@pytest.fixture
def rows():
    return np.random.default_rng(0).standard_normal((9, 5)).astype(np.float32)


def newest(hub, name="org/repo"):
    return hub.repositories[name].branches["main"]


def refused(source, **options):
    """Return the text of the error for an expert, after checking its form and its time."""
    started = time.monotonic()
    with pytest.raises(ExpertError) as error:
        load_expert(source, **options)
    seconds, text = time.monotonic() - started, str(error.value)
    assert seconds < LIMIT
    assert len(text.splitlines()) == 3
    assert "expected: " in text
    assert "next step: " in text
    return text


# --- what is fetched, and what is recorded


def test_a_run_records_the_commit_and_the_hash(hub, tmp_path):
    result = fdtasil.distill(WALKER, TOY, 3, **QUICK)
    result.save(tmp_path / "run")
    pinned = f"{WALKER}@{newest(hub)}"
    digest = hashlib.sha256((tmp_path / "walker.onnx").read_bytes()).hexdigest()
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert (report["expert"]["path"], report["expert"]["sha256"]) == (pinned, digest)
    assert (config["expert"], config["expert_sha256"]) == (pinned, digest)
    again = fdtasil.distill(pinned, TOY, 3, **QUICK)
    assert again.report["expert"] == report["expert"]


@pytest.mark.parametrize("large", [10**6, 1])
@pytest.mark.parametrize("revision", ["", "@main", "@feature/one", "@COMMIT", "@SHORT"])
def test_every_revision_is_pinned(revision, large, hub, tmp_path, rows):
    hub.large = large  # from its store, or as it is
    repository = hub.repositories["org/repo"]
    sha = repository.commit(
        {"walker.onnx": (tmp_path / "walker.onnx").read_bytes()}, "feature/one"
    )
    if revision in ("", "@main"):
        sha = newest(hub)
    uri = WALKER + revision.replace("COMMIT", sha).replace("SHORT", sha[:9])
    expert = load_expert(uri, 5, 2)
    assert expert.name == f"{WALKER}@{sha}"
    local = load_expert(tmp_path / "walker.onnx", 5, 2)
    assert expert.origin.sha256 == local.origin.sha256
    assert np.array_equal(expert.ask(rows, "check"), local.ask(rows, "check"))
    assert not any("code.py" in path for path in hub.asked())


def test_an_output_of_a_file_of_the_hub_is_chosen(hub, tmp_path, rows):
    several = mlp_onnx(tmp_path / "several.onnx", extra_outputs={"value": 2})
    hub.repositories["org/repo"].commit({"walker.onnx": several.read_bytes()})
    chosen = load_expert(WALKER, 5, 2, output="value").ask(rows, "check")
    local = load_expert(several, 5, 2, output="value").ask(rows, "check")
    assert np.array_equal(chosen, local)


def test_a_branch_that_moves_is_followed_and_a_commit_is_not(hub, tmp_path, rows):
    before = load_expert(WALKER)
    other = mlp_onnx(tmp_path / "other.onnx", scale=2.0).read_bytes()
    hub.repositories["org/repo"].commit({"walker.onnx": other})
    after = load_expert(WALKER)
    assert after.name != before.name
    assert not np.array_equal(after.ask(rows, "check"), before.ask(rows, "check"))
    assert load_expert(before.name).origin.sha256 == before.origin.sha256


def test_a_pinned_file_that_was_fetched_needs_no_network(hub, tmp_path):
    hub.repositories["org/repo"].commit(side_by_side(tmp_path, "deep/model.onnx"))
    first = load_expert("hf://org/repo/deep/model.onnx")
    asked = len(hub.requests)
    assert load_expert(first.name).origin.sha256 == first.origin.sha256
    assert len(hub.requests) == asked
    hub.close()
    huggingface_hub.close_session()  # a connection that is kept alive would still be served
    assert load_expert(first.name).origin.sha256 == first.origin.sha256
    assert "can't be used: ConnectError" in refused("hf://org/repo/deep/model.onnx")


def test_an_agent_in_a_zip(hub, tmp_path):
    hub.repositories["org/repo"].commit({"agents/sac.zip": sac(tmp_path / "sac.zip")})
    uri = "hf://org/repo/agents/sac.zip"
    expert, local = load_expert(uri), load_expert(tmp_path / "sac.zip")
    states = np.zeros((3, 3), np.float32)
    assert expert.name == f"{uri}@{newest(hub)}"
    assert expert.origin.sha256 == local.origin.sha256
    assert np.array_equal(expert.ask(states, "check"), local.ask(states, "check"))


def sac(path):
    """Save a small agent for Pendulum-v1, without a trace in the global generators."""
    import torch
    from stable_baselines3 import SAC

    state = torch.get_rng_state(), np.random.get_state()
    SAC("MlpPolicy", "Pendulum-v1", policy_kwargs={"net_arch": [8]}).save(path)
    torch.set_rng_state(state[0])
    np.random.set_state(state[1])
    return path.read_bytes()


def test_a_student_on_the_hub_says_what_it_sees(hub, tmp_path):
    student = fdtasil.distill(WALKER, TOY, 0, student_obs=[0, 1, 2], **QUICK)
    student.to_onnx(tmp_path / "student.onnx")
    data = (tmp_path / "student.onnx").read_bytes()
    hub.repositories["org/repo"].commit({"student.onnx": data})
    options = {"episodes": 2, "horizon": 20}
    expert = tmp_path / "walker.onnx"
    found = fdtasil.evaluate("hf://org/repo/student.onnx@main", expert, TOY, **options)
    assert found == fdtasil.evaluate(tmp_path / "student.onnx", expert, TOY, **options)


# --- side files


def side_by_side(folder, name, location="model.weights"):
    """Return the files of a repository that holds a model with its weights in a side file."""
    path = mlp_onnx(folder / "model.onnx", external="model.weights")
    weights, model = (
        (folder / "model.weights").read_bytes(),
        onnx.load(path, load_external_data=False),
    )
    for tensor in model.graph.initializer:
        next(e for e in tensor.external_data if e.key == "location").value = location
    beside = os.path.normpath(os.path.join(os.path.dirname(name), location))
    return {name: model.SerializeToString(), beside: weights, "model.weights.bak": b"no"}


@pytest.mark.fault(20)
@pytest.mark.parametrize("location", ["model.weights", "parts/model.weights"])
def test_side_files_come_from_the_same_commit(location, hub, tmp_path, rows):
    files = side_by_side(tmp_path, "deep/model.onnx", location)
    sha = hub.repositories["org/repo"].commit(files)
    whole = load_expert(tmp_path / "walker.onnx")
    expert = load_expert("hf://org/repo/deep/model.onnx")
    assert np.array_equal(expert.ask(rows, "check"), whole.ask(rows, "check"))
    fetched = [path for path in hub.asked() if "/resolve/" in path]
    assert fetched == [
        f"/org/repo/resolve/{sha}/deep/model.onnx",
        f"/org/repo/resolve/{sha}/deep/{location}",
    ]
    kept = [path for path in (tmp_path / "cache").rglob("*") if not path.is_dir()]
    assert len(kept) == 2
    assert not any(path.is_symlink() or path.stat().st_nlink > 1 for path in kept)


@pytest.mark.fault(17)
@pytest.mark.parametrize("location", ["../model.weights", "/etc/hostname", "a/../../../x"])
def test_a_side_file_outside_the_folder_is_neither_fetched_nor_read(location, hub, tmp_path):
    hub.repositories["org/repo"].commit(side_by_side(tmp_path, "deep/model.onnx", location))
    text = refused("hf://org/repo/deep/model.onnx")
    assert f"keeps weights in {location}" in text
    assert len([path for path in hub.asked() if "/resolve/" in path]) == 1


def test_a_side_file_that_is_missing(hub, tmp_path):
    files = side_by_side(tmp_path, "model.onnx")
    del files["model.weights"]
    hub.repositories["org/repo"].commit(files)
    assert "org/repo has no file model.weights at" in refused("hf://org/repo/model.onnx")


# --- errors


@pytest.mark.parametrize(
    ("uri", "found"),
    [
        ("hf://org/nothing/walker.onnx", "no repository org/nothing, or it is private (HTTP 401)"),
        ("hf://org/repo/runner.onnx", "org/repo has no file runner.onnx at"),
        (f"{WALKER}@nothing", "org/repo has no revision nothing"),
        (f"{WALKER}@{'0' * 40}", f"org/repo has no revision {'0' * 40}"),
        ("hf://org--x/repo/walker.onnx", "names no file of the hub"),
    ],
)
def test_what_the_hub_does_not_have(uri, found, hub):
    assert found in refused(uri)


def test_a_file_that_is_not_there_is_answered_with_those_that_are(hub):
    assert "expected: walker.onnx\n" in refused("hf://org/repo/runner.onnx")


@pytest.mark.parametrize("token", [None, "hf_secret"])
@pytest.mark.parametrize(
    ("access", "found"),
    [
        ("private", "no repository org/repo, or it is private (HTTP {})"),
        ("gated", "org/repo does not let you read walker.onnx (HTTP {})"),
    ],
)
def test_what_the_hub_does_not_give(access, found, token, hub, surroundings):
    if token:
        surroundings.setenv("HF_TOKEN", token)
    hub.repositories["org/repo"].access = access
    status = {"private": (401, 404), "gated": (401, 403)}[access][token is not None]
    text = refused(WALKER)
    assert found.format(status) in text
    assert "`hf auth login`" in text


@pytest.mark.parametrize("status", [403, 429, 500, 503])
@pytest.mark.parametrize("place", ["/api/", "/resolve/"])
def test_a_hub_in_trouble_is_asked_once(place, status, hub):
    hub.broken = (place, status)
    assert f"HTTP {status}" in refused(WALKER)
    assert len([path for path in hub.asked() if place in path]) == 1


@pytest.mark.parametrize(
    "text",
    [
        "hf://",
        "hf://org",
        "hf://org/repo",
        "hf://org/repo/",
        "hf:/org/repo/walker.onnx",
        "hf://org/repo@main/walker.onnx",
        "hf://org/repo/walker.onnx@",
        "hf://org/repo/walker.onnx@a b",
        "hf://org/repo/walker.onnx@one@two",
        "hf://org/repo/../walker.onnx",
        "hf://org/repo//walker.onnx",
        "hf://org/repo/deep\\walker.onnx",
        "hf://org/repo/walker\n.onnx",
        "hf://datasets/org/repo/walker.onnx",
    ],
)
def test_malformed_text(text, surroundings):
    assert "names no file of the hub" in refused(text)


def test_without_huggingface_hub(surroundings):
    surroundings.setitem(sys.modules, "huggingface_hub", None)
    text = refused(WALKER)
    assert "huggingface_hub can't be imported" in text
    assert 'pip install "fdtasil[hub]"' in text


@pytest.mark.fault(9)
def test_what_arrives_changed_is_not_kept(hub):
    hub.spoilt = True
    assert "arrived with 34 bytes and the hash" in refused(WALKER)
    hub.spoilt = False
    assert load_expert(WALKER).observation_size == 5


def test_no_model_is_named_for_what_it_is(hub):
    hub.repositories["org/repo"].commit({"page.onnx": b"<!DOCTYPE html>"})
    assert "HTML" in refused("hf://org/repo/page.onnx")


def test_a_cache_that_can_not_be_written(hub, tmp_path, surroundings):
    (tmp_path / "file").write_text("")
    surroundings.setenv("HF_ASSETS_CACHE", str(tmp_path / "file"))
    assert "no room for files of the hub" in refused(WALKER)


@pytest.mark.parametrize(
    "beside",
    [["vec_normalize.pkl"], ["sac/vecnormalize.pkl"], ["a/vecnormalize.pkl", "a/config.yml"]],
)
def test_statistics_beside_an_agent_are_not_forgotten(beside, hub):
    hub.repositories["org/repo"].commit({"sac.zip": b"PK"} | dict.fromkeys(beside, b"\x80"))
    text = refused("hf://org/repo/sac.zip")
    assert f"{beside[0]!r} lies beside" in text
    assert "export-sb3" in text
    assert not any("/resolve/" in path for path in hub.asked())


def test_statistics_of_another_agent_are_none_of_its_own(hub, tmp_path):
    files = {"sac.zip": sac(tmp_path / "sac.zip"), "b/vec_normalize.pkl": b"\x80"}
    hub.repositories["org/repo"].commit(files)
    assert load_expert("hf://org/repo/sac.zip").observation_size == 3


def test_nothing_of_the_hub_is_trusted(hub):
    with pytest.raises(SettingError, match="trust='pickle' with hf://"):
        load_expert(WALKER, trust="pickle")
    assert hub.asked() == []


# --- no network


@pytest.mark.fault(123)
@needs_library
def test_nobody_listens(surroundings):
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        surroundings.setenv("HF_ENDPOINT", f"http://127.0.0.1:{unused.getsockname()[1]}")
        assert "can't be used: ConnectError" in refused(WALKER)


@pytest.mark.fault(123)
@needs_library
def test_no_such_host(surroundings):
    surroundings.setenv("HF_ENDPOINT", "http://hub.invalid")
    assert "http://hub.invalid" in refused(WALKER)


def test_offline_by_choice(hub, surroundings):
    surroundings.setattr(constants, "HF_HUB_OFFLINE", True)
    assert "HF_HUB_OFFLINE is set" in refused(WALKER)
    assert hub.asked() == []


@pytest.mark.fault(123)
@pytest.mark.parametrize("place", ["/api/", "/resolve/"])
def test_a_hub_that_never_answers(place, hub, surroundings):
    """With little patience; what users have is under test in the shell."""
    surroundings.setenv("HF_HUB_DOWNLOAD_TIMEOUT", "1")
    hub.silent = place
    assert "gave no answer within 1 seconds" in refused(WALKER)
    assert len([path for path in hub.asked() if place in path]) == 1


# --- tokens


def test_a_token_is_sent_where_one_is_configured_and_not_to_the_store(hub, surroundings):
    hub.large = 1
    load_expert(WALKER)
    assert {request.token for request in hub.requests} == {None}
    hub.requests.clear()
    other = hub.repositories["org/repo"].commits[newest(hub)]
    hub.repositories["org/repo"].commit({**other, "more.txt": b"1"})
    surroundings.setenv("HF_TOKEN", "hf_secret")
    load_expert(WALKER)
    tokens = {(request.server, request.token) for request in hub.requests}
    assert tokens == {("hub", "Bearer hf_secret"), ("store", None)}


# --- a shell


def test_inspect_and_evaluate(hub, inside):
    shown = inside("inspect", WALKER, TOY, "--episodes", 1)
    assert shown.returncode == 0, shown.stderr
    assert WALKER in shown.stdout
    judged = inside("evaluate", WALKER, TOY, "--expert", WALKER, "--episodes", 2, "--horizon", 20)
    assert judged.returncode == 0, judged.stderr
    assert "normalised return" in judged.stdout


@pytest.mark.torture
def test_a_shell_without_a_network_says_so_in_time(hub, tmp_path):
    hub.silent = ""
    failed = shell("distill", WALKER, TOY, "--out", tmp_path / "run")
    # Not the start of Python, which takes its time on a busy machine.
    assert time.monotonic() - hub.requests[0].at < LIMIT
    assert failed.returncode == 1
    assert "Traceback" not in failed.stderr
    assert len(failed.stderr.strip().splitlines()) == 3
    assert "gave no answer within 6 seconds" in failed.stderr
    assert len(hub.requests) == 1


# --- a run that is handed on

TOKEN = "hf_secret"
CARD = ["README.md", "report.json", "student.onnx", "student.safetensors"]


@pytest.fixture
def writable(hub, surroundings):
    """The hub, for somebody who may write."""
    surroundings.setenv("HF_TOKEN", TOKEN)
    hub.writers.add(TOKEN)
    return hub


def pushed(hub, name="me/toy"):
    return hub.repositories[name].commits[newest(hub, name)]


def test_a_run_is_pushed_without_its_demonstrations(writable, quick_folder, inside):
    done = inside("push", quick_folder, "me/toy")
    assert done.returncode == 0, done.stderr
    files = pushed(writable)
    assert sorted(name for name in files if not name.startswith("figures/")) == CARD
    assert all(files[name] == (quick_folder / name).read_bytes() for name in files)
    assert writable.repositories["me/toy"].access == "private"
    assert f"sent: {writable.endpoint}/me/toy" in done.stdout
    for name in files:
        assert name in done.stdout.partition("sent: ")[0]
    assert {request.token for request in writable.requests} == {f"Bearer {TOKEN}"}


def test_a_whole_run_is_read_again(writable, quick_folder, inside, tmp_path):
    done = inside("push", quick_folder, "me/toy", "--public", "--demonstrations")
    assert done.returncode == 0, done.stderr
    assert "which everybody may read" in done.stdout
    assert writable.repositories["me/toy"].access == "public"
    for name, data in pushed(writable).items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(data)
    again, before = (fdtasil.Distilled.load(folder) for folder in (tmp_path, quick_folder))
    rows = before.demonstrations.observations
    assert np.array_equal(again.student.act(rows), before.student.act(rows))


def test_a_second_push_is_a_second_commit_and_changes_no_access(writable, quick_folder, inside):
    for _ in range(2):
        done = inside("push", quick_folder, "me/toy")
        assert done.returncode == 0, done.stderr
    assert len(writable.repositories["me/toy"].commits) == 2
    assert len([path for path in writable.asked() if path == "/api/repos/create"]) == 1


@pytest.mark.fault(293)
def test_no_file_of_an_earlier_run_stays_beside_the_next(writable, quick_folder, inside):
    assert inside("push", quick_folder, "me/toy", "--demonstrations").returncode == 0
    repository = writable.repositories["me/toy"]
    repository.commit({**pushed(writable), "LICENSE": b"mine", "figures/own.png": b"mine"})
    done = inside("push", quick_folder, "me/toy")
    assert done.returncode == 0, done.stderr
    files = pushed(writable)
    assert (
        not {"demonstrations.npz", "config.json", "progress.csv", "manifest.json"} & files.keys()
    )
    assert {"LICENSE", "figures/own.png", *CARD} <= files.keys()
    for name in ("demonstrations.npz", "manifest.json"):
        assert re.search(rf"removed  {name}, of an earlier push", done.stdout)
    assert "LICENSE" not in done.stdout


@pytest.mark.fault(293)
def test_files_of_a_repository_that_no_run_was_sent_to_stay(writable, quick_folder, inside):
    writable.repositories["me/bert"] = Repository("private", TOKEN)
    writable.repositories["me/bert"].commit({"config.json": b"{}", "README.md": b"mine"})
    assert inside("push", quick_folder, "me/bert").returncode == 0
    assert pushed(writable, "me/bert")["config.json"] == b"{}"


def test_a_private_repository_does_not_become_public(writable, quick_folder, inside):
    assert inside("push", quick_folder, "me/toy").returncode == 0
    refused = inside("push", quick_folder, "me/toy", "--public")
    assert refused.returncode == 2
    assert "me/toy is there already, and private" in refused.stderr
    assert refused.stdout == ""
    assert len(writable.repositories["me/toy"].commits) == 1


def test_a_card_that_was_completed_by_hand_is_sent(writable, quick_folder, inside, tmp_path):
    shutil.copytree(quick_folder, tmp_path / "run")
    (tmp_path / "run" / "README.md").write_text("license: mit")
    assert inside("push", tmp_path / "run", "me/toy").returncode == 0
    assert pushed(writable)["README.md"] == b"license: mit"


def test_nothing_is_pushed_to_a_public_repository_by_accident(writable, quick_folder, inside):
    writable.repositories["org/repo"].owner = TOKEN
    refused = inside("push", quick_folder, "org/repo")
    assert refused.returncode == 2
    assert "everybody may read it" in refused.stderr
    assert len(writable.repositories["org/repo"].commits) == 1
    assert inside("push", quick_folder, "org/repo", "--public").returncode == 0
    assert pushed(writable, "org/repo").keys() >= set(CARD)


def test_who_may_not_write_is_told_so(writable, quick_folder, inside):
    refused = inside("push", quick_folder, "org/repo", "--public")  # of another owner
    assert refused.returncode == 1
    assert "does not let you write to org/repo (HTTP 403)" in refused.stderr
    writable.writers.clear()
    assert "write to me/toy (HTTP 403)" in inside("push", quick_folder, "me/toy").stderr
    assert "me/toy" not in writable.repositories


def test_nobody_is_logged_in(hub, quick_folder, inside):
    refused = inside("push", quick_folder, "me/toy")
    assert refused.returncode == 1
    assert "nobody is logged in" in refused.stderr
    assert "`hf auth login`" in refused.stderr
    assert hub.asked() == []


@pytest.mark.parametrize(
    "name", ["toy", "me/", "/toy", "me/toy/more", "me/to y", "me/..", "a--b/c"]
)
def test_no_name_of_a_repository(name, writable, quick_folder, inside):
    refused = inside("push", quick_folder, name)
    assert refused.returncode == 2
    assert "org/name" in refused.stderr
    assert writable.asked() == []


def test_no_run_to_push(writable, tmp_path, inside):
    refused = inside("push", tmp_path, "me/toy")
    assert refused.returncode == 1
    assert "expected: " in refused.stderr
    assert writable.asked() == []


@pytest.mark.parametrize("place", ["/api/models/", "/commit/"])
def test_a_hub_that_takes_nothing(place, writable, quick_folder, inside):
    writable.broken = (place, 500)
    refused = inside("push", quick_folder, "me/toy")
    assert refused.returncode == 1
    assert "HTTP 500" in refused.stderr
    assert "Traceback" not in refused.stderr


def test_pushing_without_huggingface_hub(surroundings, quick_folder, inside):
    surroundings.setitem(sys.modules, "huggingface_hub", None)
    refused = inside("push", quick_folder, "me/toy")
    assert refused.returncode == 1
    assert 'pip install "fdtasil[hub]"' in refused.stderr


# --- the stand-in itself


@pytest.mark.parametrize("large", [10**6, 1])
def test_huggingface_hub_takes_the_stand_in_for_the_hub(large, hub, tmp_path):
    hub.large = large
    path = huggingface_hub.hf_hub_download(
        "org/repo", "walker.onnx", endpoint=hub.endpoint, cache_dir=tmp_path / "theirs"
    )
    with open(path, "rb") as file:
        assert file.read() == (tmp_path / "walker.onnx").read_bytes()
    assert newest(hub) in path


@pytest.mark.fault(259)
def test_a_download_that_is_given_up_ends():
    taken = []

    def without_end():
        while True:
            taken.append(1)
            time.sleep(0.001)
            yield b"part"

    parts = requests._patiently(without_end(), uri.parse(WALKER))
    assert next(parts) == b"part"
    parts.close()
    time.sleep(0.1)
    before = len(taken)
    time.sleep(0.2)
    assert len(taken) == before
