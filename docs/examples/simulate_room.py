"""Write room.csv and room_next.csv, the data of the guide: two days of a simulated room, and the twelve hours after."""

import csv
import datetime
from pathlib import Path

import jax
import numpy as np
import room

import lfm_ppl as lfm

HERE = Path(__file__).resolve().parent
START = datetime.datetime(2026, 1, 12)
TRUTH = {"loss": 0.15, "gain": 1.8, "scale": 0.5, "lengthscale": 3.0, "noise_sd": 0.1}
HOURS, STEP, FITTED = 60.0, 0.5, 48.0
LOST = (31, 32, 33, 70)  # rows whose measurement failed


def main():
    """Simulate, and write the files beside this one."""
    jax.config.update("jax_enable_x64", True)
    times = np.arange(0.0, HOURS + STEP / 2, STEP)
    clock = times % 24.0
    heater = np.where((clock >= 6.0) & (clock < 9.0) | (clock >= 16.0) & (clock < 22.0), 1.5, 0.3)
    outside = np.round(4.0 - 4.0 * np.cos(2 * np.pi * (clock - 3.0) / 24.0), 1)
    inputs = {"heater": lfm.Input(times, heater), "outside": lfm.Input(times, outside, "linear")}
    drawn = lfm.simulate(jax.random.key(4), room.build(inputs, **TRUTH), times)
    temperature = np.round(np.asarray(drawn.y)[:, 0], 2)
    rows = [
        (START + datetime.timedelta(hours=float(t)), "" if k in LOST else f"{y:.2f}", f"{p:.1f}", f"{o:.1f}")
        for k, (t, y, p, o) in enumerate(zip(times, temperature, heater, outside, strict=True))
    ]
    fitted = int(FITTED / STEP) + 1
    for name, part in (("room.csv", rows[:fitted]), ("room_next.csv", rows[fitted:])):
        with open(HERE / name, "w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(("time", "temperature", "heater", "outside"))
            writer.writerows((when.isoformat(timespec="minutes"), *rest) for when, *rest in part)


if __name__ == "__main__":
    main()
