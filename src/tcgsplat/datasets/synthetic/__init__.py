"""A synthetic apartment as an RGB-D sequence: exact depth, poses and mesh; a real camera's faults on demand."""

from tcgsplat.datasets.synthetic.synthesis import Step, SynthConfig, greatest_step, synthesize

__all__ = ["Step", "SynthConfig", "greatest_step", "synthesize"]
