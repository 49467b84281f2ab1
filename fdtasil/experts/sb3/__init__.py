"""Agents of stable-baselines3 as torch modules and ONNX files, read without running their code.

A zip that stable-baselines3 wrote holds pickles, and a pickle runs any code when it is opened. The
numbers of a policy stand outside of them: `policy.pth` is read by torch's `weights_only` reader,
and what has to be known besides (class names, the activation, the action bounds) is there as text.
`trust="pickle"` hands what can't be read so to stable-baselines3; besides it only logs
import that library.
"""
