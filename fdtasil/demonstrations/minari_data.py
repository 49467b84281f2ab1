"""Minari datasets in and out; the package minari (`[data]`) is loaded when one is."""

import importlib
import os
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

from fdtasil.demonstrations.dataset import Dataset, form_of, in_form
from fdtasil.demonstrations.states import Demonstrations
from fdtasil.errors import FdtasilError, SettingError, StorageError, first_line, shown
from fdtasil.files.border import reads
from fdtasil.files.hdf5 import check_hdf5
from fdtasil.files.names import check_no_links, stays_inside
from fdtasil.files.reading import from_json, read_plain
from fdtasil.files.storage import remove_folder
from fdtasil.rollouts.flattening import bounds_of, unbounded
from fdtasil.rollouts.narrowing import Narrowing
from fdtasil.rollouts.spaces import Mismatch, Spaces, UnknownSpace

if TYPE_CHECKING:
    import minari

__all__ = ["from_minari", "to_minari"]

EXPERT_ACTION, DISPLACEMENTS, VALUES = "expert_action", "probe_displacements", "probe_values"
"""Keys of an exported dataset's infos."""
_FORM = "fdtasil"  # key of its metadata: what the numbers of its rows are


def from_minari(source: "str | minari.MinariDataset") -> Dataset:
    """Read demonstrations from a local Minari dataset.

    Its actions are taken as the expert's, unless its infos hold "expert_action", as `to_minari`
    writes it. Answers to probes are not read.

    Args:
        source: A dataset, or the id of one that lies on this machine; nothing is downloaded.

    Raises:
        StorageError: If there is no such dataset.
        SettingError: If its spaces have no flat form, or minari is not installed.
    """
    name = source if isinstance(source, str) else source.spec.dataset_id
    read = reads(
        f"the Minari dataset {shown(name)!r}",
        "a dataset whose files hold their own data, without links",
        "download it again, and do not use this one",
        passes=FdtasilError,
    )
    return read(_dataset_of)(source, _minari())


def _dataset_of(source: "str | minari.MinariDataset", minari: Any) -> Dataset:
    if isinstance(source, str):
        folder = _folder_of(source)
        if not (folder / "data").is_dir():
            raise StorageError(
                f"no Minari dataset {source!r} on this machine",
                "one that `minari list local` shows",
                f"minari download {source}",
            )
        metadata = _checked(folder / "data")
        data = minari.load_dataset(source)
    else:
        data = source
        metadata = _checked(Path(data.storage.data_path))
    spaces = _spaces_of(data)
    narrowing = Narrowing(spaces.observations.size, str(data.spec.dataset_id))
    episodes = [
        _read(number, episode, spaces, narrowing)
        for number, episode in enumerate(data.iterate_episodes())
    ]
    if not episodes:
        raise StorageError(f"{source!r} has no episodes", "at least one", "choose another dataset")
    states = Demonstrations.joined(episodes)
    narrowing.judge_a_log()
    ends = bounds_of(data.action_space, spaces.actions)
    low, high = (np.asarray(unbounded(bound), np.float32) for bound in ends)
    name = data.env_spec.id if data.env_spec else data.spec.dataset_id
    if _FORM in metadata:  # flat rows of ours, of any form
        return in_form(Dataset(states, None, None, low, high, str(name)), metadata[_FORM])
    return Dataset(states, None, None, low, high, str(name), spaces.unless_plain)


def _spaces_of(data: "minari.MinariDataset") -> Spaces:
    try:
        return Spaces.of(data)
    except UnknownSpace as unknown:
        raise SettingError(
            f"a dataset with {shown(str(unknown))}",
            "boxes and choices, and dictionaries and tuples of them",
            "flatten it, or choose another",
        ) from None


def _folder_of(dataset_id: str) -> Path:
    """Return where a dataset of a name lies, or would.

    Raises:
        StorageError: If the name is a path that leads elsewhere.
    """
    if not stays_inside(dataset_id):
        raise StorageError(
            f"a Minari dataset named {shown(dataset_id)!r}",
            "an id such as cheetah/sac-v0",
            "name it so: it is kept in Minari's own folder",
        )
    # As Minari finds it; its own function makes folders on the way.
    root = os.environ.get("MINARI_DATASETS_PATH") or Path.home() / ".minari" / "datasets"
    return Path(root, dataset_id)


_METADATA, _METADATA_LIMIT = "metadata.json", 2**24


def _checked(folder: Path) -> dict[str, Any]:
    """Return the metadata of a dataset; refuse what would read other files, or import modules.

    Raises:
        ValueError: If it would.
    """
    check_no_links(folder)
    metadata = from_json(read_plain(folder / _METADATA, _METADATA_LIMIT))
    if not {"observation_space", "action_space"} <= metadata.keys():
        # Minari would make the environment that the file names, from any module.
        raise ValueError("its metadata do not say its spaces")
    for file in sorted(folder.glob("**/*.hdf5")):
        check_hdf5(file)
    return metadata


def to_minari(dataset: Dataset, dataset_id: str, **about: str) -> "minari.MinariDataset":
    """Write demonstrations as a local Minari dataset.

    An episode's actions are those that were taken; infos hold the expert's at every step
    ("expert_action") and, with probes, "probe_displacements" and "probe_values" as in `Answers`.
    The state after the last step is not recorded, so the last observation stands twice. All are
    flat rows of numbers, scores of choices among them; "fdtasil" in the metadata says what they
    are made of, and `from_minari` reads that.

    Args:
        dataset: What to write.
        dataset_id: Minari's id, for example "cheetah/sac-v0".
        **about: Minari's algorithm_name, author, author_email, code_permalink, description.

    Raises:
        SettingError: If minari is not installed, or it is no dataset.
        StorageError: If the dataset exists already or can't be written.
    """
    minari = _minari()
    if not isinstance(dataset, Dataset):
        raise SettingError(
            f"dataset is a {type(dataset).__name__}", "a Dataset", "write result.dataset"
        )
    # Its type says lists, it takes arrays, and its own module would import jax to add steps.
    buffer: Any = importlib.import_module("minari.data_collector").EpisodeBuffer
    states, n = dataset.demonstrations, dataset.sizes[0]
    buffers = []
    # Minari counts without a gap; a run leaves out episodes that its expert had no answer in.
    for place, number in enumerate(np.unique(states.episode)):
        rows = np.flatnonzero(states.episode == number)
        steps, doubled = len(rows), np.append(rows, rows[-1])
        infos: dict[str, Any] = {EXPERT_ACTION: states.actions[doubled]}
        if dataset.answers is not None:
            infos[DISPLACEMENTS] = dataset.answers.displacements[dataset.answers.numbers[doubled]]
            infos[VALUES] = dataset.answers.values[doubled]
        buffers.append(
            buffer(
                id=place,
                observations=states.observations[doubled],
                actions=states.taken[rows],
                rewards=states.rewards[rows].tolist(),
                terminations=states.terminated[rows].tolist(),
                truncations=[False] * (steps - 1) + [not states.terminated[rows[-1]]],
                infos=infos,
            )
        )
    folder = _folder_of(dataset_id)
    # Minari makes the folder, and one for each part of the name before it.
    parts = len(PurePosixPath(dataset_id).parts)
    made = [place for place in (folder, *folder.parents)[:parts] if not place.exists()]
    try:
        written = minari.create_dataset_from_buffers(
            dataset_id,
            buffers,
            observation_space=gymnasium.spaces.Box(-np.inf, np.inf, (n,), np.float32),
            action_space=gymnasium.spaces.Box(dataset.low, dataset.high, dtype=np.float32),
            requirements=[],
            **about,
        )
        if form := form_of(dataset):
            written.storage.update_metadata({_FORM: form})
        return written
    except BaseException as error:
        if made:
            remove_folder(made[-1])
        if not isinstance(error, Exception):
            raise
        raise StorageError(
            f"Minari can't write {shown(dataset_id)!r}: {first_line(error)}",
            "a new id such as cheetah/sac-v0",
            f"choose another id, or `minari delete {shown(dataset_id)}`",
        ) from error


def _read(number: int, episode: Any, spaces: Spaces, narrowing: Narrowing) -> Demonstrations:
    steps, n, m = len(episode.rewards), spaces.observations.size, spaces.actions.size
    try:
        taken = spaces.actions.centred(spaces.actions.rows(episode.actions))
        wide = spaces.observations.rows(episode.observations)
    except Mismatch as mismatch:
        raise ValueError(f"episode {number} has {mismatch}") from None
    taken, observations = (part.astype(np.float32)[:steps] for part in (taken, wide))
    if steps:
        narrowing.see(wide[:steps], observations)
    infos = episode.infos or {}
    labels = np.asarray(infos.get(EXPERT_ACTION, taken), np.float32)[:steps]
    rewards = np.asarray(episode.rewards, np.float64)
    terminated = np.asarray(episode.terminations, bool)
    shapes = [array.shape for array in (observations, taken, labels, rewards, terminated)]
    if shapes != [(steps, n), (steps, m), (steps, m), (steps,), (steps,)]:
        raise ValueError(f"episode {number} of {steps} steps has arrays of shapes {shapes}")
    return Demonstrations(
        observations,
        labels,
        np.full(steps, number, np.int32),
        np.zeros(steps, np.int32),
        taken,
        rewards,
        terminated,
    )


def _minari() -> Any:
    try:
        import minari
    except ImportError as error:
        raise SettingError(
            f"Minari datasets without the package minari ({error})",
            "minari[hdf5]",
            'pip install "fdtasil[data]"',
        ) from error
    return minari
