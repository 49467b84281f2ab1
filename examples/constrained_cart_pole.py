"""Distil a model-predictive controller with hard limits, which has no answer at some states.

    pip install "fdtasil[mpc]"
    python examples/constrained_cart_pole.py

The controller balances a pole on a cart whose rail ends: an optimisation by casadi and ipopt at
every step, with limits on position and force. Where nothing keeps the cart on its rail, it has no
answer, which is a row of NaN.
"""

from functools import cache

import casadi
import gymnasium
import numpy as np

import fdtasil

STEP, AHEAD = 0.05, 20  # seconds, and steps that are looked ahead
RAIL, FORCE = 1.0, 15.0  # metres to each side, newtons
WEIGHTS = np.array([4.0, 20.0, 0.1, 0.4])  # of position, angle and their speeds
EFFORT = 2e-3


def moved(state, force, sin=np.sin, cos=np.cos):
    """Return the time derivatives of position, angle and their speeds (4 arrays of any shape)."""
    cart, pole, half = 1.0, 0.2, 0.5  # kilograms, and metres to the pole's centre
    _, angle, speed, turning = state
    push = (force + pole * half * turning**2 * sin(angle)) / (cart + pole)
    turned = (9.81 * sin(angle) - cos(angle) * push) / (
        half * (4 / 3 - pole * cos(angle) ** 2 / (cart + pole))
    )
    return speed, turning, push - pole * half * turned * cos(angle) / (cart + pole), turned


def stepped(state, force, sin=np.sin, cos=np.cos):
    """Return the state a step later (Runge-Kutta of order four)."""

    def shifted(slope, share):
        return [s + share * STEP * d for s, d in zip(state, slope, strict=True)]

    first = moved(state, force, sin, cos)
    second = moved(shifted(first, 0.5), force, sin, cos)
    third = moved(shifted(second, 0.5), force, sin, cos)
    last = moved(shifted(third, 1.0), force, sin, cos)
    slopes = zip(first, second, third, last, strict=True)
    return [
        s + STEP / 6 * (a + 2 * b + 2 * c + d)
        for s, (a, b, c, d) in zip(state, slopes, strict=True)
    ]


class CartPole(gymnasium.Env):
    """The plant: observed as it is, rewarded by up to 1 a step, over when the pole falls."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (4,), np.float64)
    action_space = gymnasium.spaces.Box(-FORCE, FORCE, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = self.np_random.uniform(-1, 1, 4) * [0.85, 0.15, 0.6, 0.3]
        return self.state, {}

    def step(self, action):
        self.state = np.array(stepped(self.state, float(action[0])))
        cost = float(WEIGHTS @ self.state**2) + EFFORT * float(action[0]) ** 2
        return self.state, 1 / (1 + cost), bool(abs(self.state[1]) > 0.8), False, {}


@cache
def planner():
    """Return the optimisation, its bounds, and a plan to begin with."""
    states, forces = casadi.SX.sym("x", 4, AHEAD), casadi.SX.sym("u", AHEAD)
    start, cost, gaps, before = casadi.SX.sym("start", 4), 0, [], None
    for k in range(AHEAD):
        before = start if before is None else states[:, k - 1]
        after = casadi.vertcat(
            *stepped(casadi.vertsplit(before), forces[k], casadi.sin, casadi.cos)
        )
        gaps.append(states[:, k] - after)
        cost += casadi.dot(casadi.DM(WEIGHTS), states[:, k] ** 2) + EFFORT * forces[k] ** 2
    problem = {
        "x": casadi.vertcat(casadi.vec(states), forces),
        "f": cost,
        "g": casadi.vertcat(*gaps),
        "p": start,
    }
    quiet = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.max_iter": 60}
    high = np.r_[np.tile([RAIL, np.inf, np.inf, np.inf], AHEAD), np.full(AHEAD, FORCE)]
    return casadi.nlpsol("planner", "ipopt", problem, quiet), high


def controller(observations):
    """Answer (B, 4) states with (B, 1) forces; a row of NaN where the rail is too short."""
    solve, high = planner()
    answers = np.full((len(observations), 1), np.nan)
    for row, state in enumerate(observations.astype(float)):
        guess = np.r_[np.tile(state, AHEAD), np.zeros(AHEAD)]
        plan = solve(x0=guess, p=state, lbx=-high, ubx=high, lbg=0, ubg=0)
        if solve.stats()["success"]:
            answers[row] = float(plan["x"][4 * AHEAD])
    return answers


# Ipopt itself may be beyond a limit by 1e-8.
LIMITS = {"rail": lambda observations, actions: np.abs(observations[:, 0]) > RAIL + 1e-6}

if __name__ == "__main__":
    result = fdtasil.distill(
        controller,
        CartPole,
        probes="10,forward",
        episodes=3,
        horizon=100,
        constraints=LIMITS,
    )
    print(result)
    print("share without an answer:", result.report["no_answer"])
