"""From tile to posterior plot: python pipelines/tutorial.py [--picture FILE.png]."""

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import sasmap

# %% a survey, one of its passes, the clip of a cell
parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--picture", type=Path, default=Path("posterior.png"))
picture = parser.parse_args().picture
survey = sasmap.load_survey(Path(__file__).parents[1] / "sample_data" / "survey.yaml")
amplitude = sasmap.open_pass(survey, "near")  # lazy: nothing but headers has been read
clip = amplitude[:500, :500]
print(f"ranges {float(clip.ground_range.min()):.1f} to {float(clip.ground_range.max()):.1f} m")

# %% its posterior
posterior = sasmap.ripples.estimate(clip, survey.ripples, rng=1)
print(posterior.quality.label, posterior.left_out, posterior.rhat)
print(posterior.quantiles[["frequency", "height"]].to_dataframe())

# %% draws of f and A_H beside the clip
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
left.imshow(clip, cmap="gray", vmax=float(np.nanquantile(clip, 0.99)))
right.plot(posterior.draws.frequency.values.ravel(), posterior.draws.height.values.ravel(), ",")
right.set(xlabel="f (cycles/m)", ylabel="A_H (m)")
figure.savefig(picture)
