"""Fractions that a monitor would see in many experiments, frame by frame, by correlation and by the joint fit.

python tests/benchmark_loops.py --in-view 50 --loops 100

Each frame is evaluated once; notebook 12 then lets the clock and the rules of decision run over the table. It writes
data/live_loops.parquet after each experiment, and goes on from there when it is called again. About 4 s of a processor
for an experiment with 50 particles in view, 8 s with 100.
"""

import argparse
from time import process_time

import cv2
import numpy as np
import pandas as pd

from gdptlab import Calibration, datasets, locate
from gdptlab._files import written_whole
from gdptlab.experiment import trigger_time
from gdptlab.experiment.channel import Acoustics, Focusing
from gdptlab.experiment.film import Film
from gdptlab.live import Follower, middle_thirds, true_fractions

PATH = datasets.DATA / "live_loops.parquet"
E_AC, SCATTER, LEVEL = 6.0, 0.3, 0.9
FIRST_SEED = 1000
AFTER_S = 0.3  # for which frames are evaluated after the last of the true trigger times


def template_ms() -> float:
    """Processor time of Y: one call of cv2.matchTemplate, 61 x 61 px on 512 x 512 px."""
    frame, times = np.random.default_rng(0).random((512, 512), np.float32), []
    for _ in range(7):
        start = process_time()
        cv2.matchTemplate(frame, frame[:61, :61], cv2.TM_CCOEFF_NORMED)
        times.append(1e3 * (process_time() - start))
    return float(np.median(times))


def experiment(seed: int, in_view: float) -> pd.DataFrame:
    """What is seen in each frame of one experiment, by both methods, and what is true."""
    energy = E_AC * (1 + SCATTER * np.random.default_rng(seed).uniform(-1, 1))
    focusing = Focusing(acoustics=Acoustics(energy_density_J_m3=energy))
    film = Film.seeded(seed, focusing=focusing, mean_in_view=in_view, duration_s=5.0)
    fine_s = np.arange(0, 5, 0.005)
    truth = true_fractions(film, fine_s)
    whole = {"seed": seed, "in_view": in_view, "energy_density_J_m3": energy, "y_ms": template_ms()}
    for of, axis in {"h": "z", "w": "y"}.items():
        whole[f"true_{of}_s"] = trigger_time(fine_s, truth[f"fraction_{of}"], LEVEL)
        whole[f"sample_{of}_s"] = focusing.trigger_time(axis, LEVEL)
    last = np.nanmax([value for name, value in whole.items() if name.endswith("_s")]) + AFTER_S
    plain = Calibration.from_stack(*film.stack(size=31), n_sub=9)
    follower = Follower(Calibration.from_stack(*film.stack(size=63), n_sub=9))
    follower(film[0])
    thirds, rows = middle_thirds(focusing.channel, film.to_channel), []
    for k in range(min(len(film), int(last * film.frame_rate_hz))):
        image, row = film[k], {"frame": k, "t_s": film.times_s[k]}
        for method in ("correlation", "joint"):
            start = process_time()
            table = locate(image, plain) if method == "correlation" else follower(image, film.times_s[k])
            row[f"{method}_ms"] = 1e3 * (process_time() - start)
            row[f"{method}_count"] = len(table)
            for of, third in thirds.items():
                fraction = third(table)
                row |= {f"{method}_{of}": float(fraction), f"{method}_{of}_low": fraction.low}
        rows.append(row)
    table = pd.DataFrame(rows)
    seen = true_fractions(film, table["t_s"])
    table[["true_count", "true_h", "true_w"]] = seen[["count", "fraction_h", "fraction_w"]].to_numpy()
    return table.assign(**whole)


def main() -> None:
    """Add the experiments that are missing."""
    parser = argparse.ArgumentParser(description="Evaluate experiments for notebook 12.")
    parser.add_argument("--in-view", type=float, default=50.0)
    parser.add_argument("--loops", type=int, default=100)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    table = pd.read_parquet(PATH) if PATH.exists() else pd.DataFrame({"seed": [], "in_view": []})
    done = set(zip(table["seed"], table["in_view"], strict=True))
    for seed in range(FIRST_SEED, FIRST_SEED + options.loops):
        if (seed, options.in_view) in done:
            continue
        part = experiment(seed, options.in_view)
        table = pd.concat([table, part], ignore_index=True) if len(table) else part
        narrow = table.astype({name: "float32" for name in table.select_dtypes("float64") if name != "t_s"})
        with written_whole(PATH) as temporary:
            narrow.to_parquet(temporary, index=False, compression="zstd")
        print(seed, len(part), part.filter(like="_ms").median().round(1).to_dict(), flush=True)


if __name__ == "__main__":
    main()
