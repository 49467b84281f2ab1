"""Why an expert has more or fewer numbers than its environment."""

__all__ = ["AS_A_STUDENT", "size_hint"]

AS_A_STUDENT = (
    "judge it with fdtasil.evaluate, which knows what it sees; as an expert, pass a function of "
    "whole observations that asks it"
)
"""Next step where the file of a student that sees less, or more, is in the place of an expert."""

# What an environment gives in one version or with one option, and in the other.
_VERSIONS = {
    frozenset({27, 105}): "Ant-v4 gives 27, Ant-v5 105; include_cfrc_ext_in_observation= is why",
    frozenset({27, 111}): "Ant-v3 gives 111, Ant-v4 27",
    frozenset({105, 111}): "Ant-v3 gives 111, Ant-v5 105",
    frozenset({348, 376}): "Humanoid-v4 gives 376, Humanoid-v5 348",
    frozenset({9, 11}): "InvertedDoublePendulum-v4 gives 11, InvertedDoublePendulum-v5 9",
    frozenset({10, 11}): "Reacher-v4 gives 11, Reacher-v5 10",
}
_STACKS = range(2, 17)


def size_hint(ours: int, theirs: int) -> str:
    """Return the next step where an expert's observations are more or fewer than they should be.

    Args:
        ours: What the expert takes.
        theirs: What the environment gives.
    """
    known = _VERSIONS.get(frozenset({ours, theirs}))
    if known is not None:
        return f"check the environment's version ({known})"
    if ours == theirs + 1:
        return (
            "wrap the environment as in training; one more is often the time, added by "
            "gymnasium.wrappers.TimeAwareObservation or sb3_contrib's TimeFeatureWrapper"
        )
    if ours > theirs and ours % theirs == 0 and ours // theirs in _STACKS:
        return (
            f"it may have been trained on {ours // theirs} stacked observations: wrap the "
            "environment in FrameStackObservation and FlattenObservation"
        )
    if 0 < ours - theirs <= 2:
        return (
            "check the environment's options; one or two more are often positions, by "
            "exclude_current_positions_from_observation=False"
        )
    return (
        "check the environment's version, options and wrappers; judge a student with the history= "
        "or student_obs= that it was distilled with"
    )
