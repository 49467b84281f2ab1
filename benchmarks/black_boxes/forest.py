"""Boosted trees as ONNX that were taught to do what a shipped expert does."""

from pathlib import Path

import numpy as np

from fdtasil.experts.expert import Expert

from .box import measure
from .visits import shipped_expert, visited

_NOISE = (0.0, 0.1, 0.3)  # of the actions, which lie in [-1, 1]


def make_forest(
    folder: Path,
    environment: str = "HalfCheetah-v5",
    trees: int = 300,
    rounds: int = 5,
    episodes: int = 20,
    horizon: int = 300,
) -> Path:
    """Fit boosted trees to a shipped expert, and write them as one ONNX file.

    Trees that know the expert's states alone fall off its path at the first step, as any copy
    does. So they are fitted anew to the expert's answers at the states that they came to
    themselves (DAgger), after a first round on the expert's states, calm and disturbed.

    Args:
        folder: Where the file goes.
        environment: Which shipped expert.
        trees: Number of trees for each action.
        rounds: How often they are fitted.
        episodes: Episodes added in each round.
        horizon: Steps of an episode.

    Returns:
        The path of the file.
    """
    expert, path = shipped_expert(environment), folder / "forest.onnx"
    states = [
        visited(expert, environment, episodes, horizon),
        visited(expert, environment, 2 * episodes, horizon, _NOISE, seed=1),
    ]
    for turn in range(rounds):
        path.write_bytes(_fitted(expert, np.concatenate(states), trees))
        if turn + 1 < rounds:
            own = measure(path, environment, horizon, episodes, seed=2 + turn)
            states.append(own.observations[own.valid])
    return path


def _fitted(expert: Expert, states: np.ndarray, trees: int) -> bytes:
    import lightgbm

    answers = expert.ask(states, "label")
    settings = {
        "learning_rate": 0.15,
        "num_leaves": 31,
        "seed": 0,
        "num_threads": 1,
        "deterministic": True,
        "force_row_wise": True,  # left open, the faster of two orders of summing is taken
        "verbose": -1,
    }
    boosters = [
        lightgbm.train(settings, lightgbm.Dataset(states, answer.copy()), trees)
        for answer in answers.T
    ]
    return _one_graph(boosters, states.shape[1])


def _one_graph(boosters: list, observation_size: int) -> bytes:
    """Join the ensembles of the single actions: their trees side by side, one target for each."""
    from onnx import TensorProto, helper
    from onnxmltools.convert import convert_lightgbm
    from onnxmltools.convert.common.data_types import FloatTensorType

    joined: dict[str, list] = {}
    inputs = [("observations", FloatTensorType([None, observation_size]))]
    for action, booster in enumerate(boosters):
        graph = convert_lightgbm(booster, initial_types=inputs, target_opset=15).graph
        (node,) = (n for n in graph.node if n.op_type == "TreeEnsembleRegressor")
        parts = {a.name: helper.get_attribute_value(a) for a in node.attribute}
        parts["target_ids"] = [action] * len(parts["target_ids"])
        first = 1 + max(joined.get("nodes_treeids", [-1]))
        for name in ("nodes_treeids", "target_treeids"):
            parts[name] = [tree + first for tree in parts[name]]
        for name, values in parts.items():
            if isinstance(values, list):
                joined.setdefault(name, []).extend(values)
    sums = helper.make_node(
        "TreeEnsembleRegressor",
        ["observations"],
        ["sums"],
        domain="ai.onnx.ml",
        n_targets=len(boosters),
        **joined,
    )
    bounds = [helper.make_tensor(n, TensorProto.FLOAT, [], [v]) for n, v in _BOUNDS.items()]
    graph = helper.make_graph(
        [sums, helper.make_node("Clip", ["sums", *_BOUNDS], ["actions"])],
        "forest",
        [_value("observations", observation_size)],
        [_value("actions", len(boosters))],
        bounds,
    )
    versions = [helper.make_opsetid("", 17), helper.make_opsetid("ai.onnx.ml", 3)]
    model = helper.make_model(graph, opset_imports=versions, ir_version=8)
    return model.SerializeToString(deterministic=True)


_BOUNDS = {"low": -1.0, "high": 1.0}


def _value(name: str, width: int):
    from onnx import TensorProto, helper

    return helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", width])
