"""Who acts in an environment, and what is recorded: environments, behaviours, episodes."""
