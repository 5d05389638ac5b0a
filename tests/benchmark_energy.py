"""Links, and the energy density with its interval, of films measured one by one; prints a summary.

Film and fit assume the same water and spheres; notebook 11 has the test in which they do not.

Half an hour of computing: python tests/benchmark_energy.py --films 100 --jobs 2
"""

import argparse

import pandas as pd
from joblib import Parallel, delayed
from tqdm import tqdm

from gdptlab import Calibration, batch
from gdptlab.experiment.channel import Acoustics, Focusing
from gdptlab.experiment.film import Film
from gdptlab.tracking.acoustic_energy import fit_energy
from gdptlab.tracking.tracks import link, link_scores

E_AC = 1.2  # J/m³
FOCUSING = Focusing(acoustics=Acoustics(energy_density_J_m3=E_AC))
IN_VIEW, DURATION_S, SIZE_PX, N_SUB = 50.0, 10.0, 63, 9  # the last two of the calibration
LINKS = {"search_range": (1.5, 1.5, 4.0), "memory": 8, "min_rows": 10}
FIRST_SEED, FIRST_STACK, SHARE_A_STACK = 5000, 100, 10
ENERGIES = ["E_y_J_m3", "E_z_J_m3", "E_J_m3"]


def measured(number: int) -> dict[str, float]:
    """Seed, links, and energies of one film."""
    film = Film.seeded(FIRST_SEED + number, focusing=FOCUSING, mean_in_view=IN_VIEW, duration_s=DURATION_S)
    stack = film.stack(size=SIZE_PX, seed=FIRST_STACK + number // SHARE_A_STACK)
    table = batch(film, Calibration.from_stack(*stack, n_sub=N_SUB), method="joint", progress=False)
    tracks = link(film.to_channel(table), predictor=FOCUSING.channel, frame_rate_hz=film.frame_rate_hz, **LINKS)
    scores, fit = link_scores(tracks, film.truth()), fit_energy(tracks, FOCUSING, film.frame_rate_hz)
    row = {"seed": film.seed, "links_right": scores["right"], "links_found": scores["found"]}
    return row | {f"{name}_{column}": fit.loc[name, column] for name in ENERGIES for column in ("value", "low", "high")}


def main() -> None:
    """Run all and print a summary."""
    parser = argparse.ArgumentParser(description="Measure films, link, fit the energy density.")
    parser.add_argument("--films", type=int, default=100)
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    options = parser.parse_args()
    jobs = (delayed(measured)(k) for k in range(options.films))
    rows = Parallel(n_jobs=options.jobs, return_as="generator")(jobs)
    table = pd.DataFrame(list(tqdm(rows, desc="films", total=options.films)))
    print(table[["links_right", "links_found"]].describe().loc[["mean", "min"]].round(4))
    for name in ENERGIES:
        covered = (table[f"{name}_low"] <= E_AC) & (table[f"{name}_high"] >= E_AC)
        off = 100 * (table[f"{name}_value"] / E_AC - 1)
        print(f"{name}: covered {covered.sum()} of {len(table)}, largest deviation {off.abs().max():.4f} %")


if __name__ == "__main__":  # processes that are started import this file
    main()
