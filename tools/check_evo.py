"""Compares the localization errors of a run with those that evo finds in the run's trajectories.

    pip install evo
    python3 tools/check_evo.py target/realo/late_fusion/drive/cav1
"""

import json
import math
import sys
from pathlib import Path

import numpy as np
from evo.core import metrics
from evo.core.trajectory import Plane
from evo.tools import file_interface


def evo_errors(trajectories, agent, relation):
    """Errors on the ground between an agent's two trajectories, whose poses are at the same stamps."""
    pair = [file_interface.read_tum_trajectory_file(str(folder / f"{agent}.tum"))
            for folder in (trajectories / "truth", trajectories)]
    for trajectory in pair:
        trajectory.project(Plane.XY)
    metric = metrics.APE(relation)
    metric.process_data(tuple(pair))
    return np.sort(np.abs(metric.error))


def main(run):
    scores = json.loads((run / "result.json").read_text()).get("localization", {})
    kinds = [("position_m", metrics.PoseRelation.translation_part, 2e-6),
             ("heading_deg", metrics.PoseRelation.rotation_angle_deg, 2e-5)]
    apart, compared = [], 0
    for agent, of_agent in scores.items():
        if "position_m" not in of_agent:
            continue
        for key, relation, rounding in kinds:
            found = evo_errors(run / "trajectories", agent, relation)
            at = max(math.ceil(0.95 * len(found)), 1) - 1
            evo = {"mean": found.mean(), "p95": found[at], "max": found[-1]}
            for name, value in evo.items():
                ours = of_agent[key][name]
                compared += 1
                print(f"{agent} {key} {name}: {ours:.6f}, evo {value:.6f}")
                if abs(ours - value) > rounding:
                    apart.append(f"{agent} {key} {name}")
    if not compared:
        advice = "take the folder of one ego of `realo run … --localization map` on a log with true poses"
        sys.exit(f"{run}: expected errors of estimated poses, found none: {advice}")
    if apart:
        sys.exit("evo finds other errors: " + ", ".join(apart))
    print("evo finds the same errors")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
