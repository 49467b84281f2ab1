"""An agent of stable-baselines3, read from its zip without unpickling anything."""

from stable_baselines3 import SAC
from stable_baselines3.common.evaluation import evaluate_policy

import fdtasil

STEPS = 5_000

if __name__ == "__main__":
    agent = SAC("MlpPolicy", "Pendulum-v1", seed=0)
    agent.learn(STEPS)
    agent.save("agent.zip")

    result = fdtasil.distill("agent.zip", "Pendulum-v1", episodes=1)
    print(result.evaluation)
    # A student has the agent's own interface.
    mean, deviation = evaluate_policy(result.student, agent.get_env(), n_eval_episodes=5)
    print(f"return {mean:.0f} +- {deviation:.0f}")
