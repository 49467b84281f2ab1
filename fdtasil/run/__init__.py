"""The loop: from the arguments of `distill` over its rounds to a result, over interruptions."""
