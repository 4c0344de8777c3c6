"""Print the sensor table as Markdown, as docs/sensors.md holds it."""

from __future__ import annotations

import numpy as np

from retropole.sensors import SENSORS


def main() -> None:
    print("| sensor | beams | elevation | step | noise mm | threshold | whose threshold | source |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for s in SENSORS.values():
        low, high = np.degrees(s.elevation_span)
        beams = str(len(s.elevations)) if s.pattern == "spinning" else "rosette"
        step = f"{np.degrees(s.azimuth_step):.2f}°" if s.azimuth_step else "none"
        print(
            f"| {s.name} | {beams} | {low:+.1f}° to {high:+.1f}° | {step} | "
            f"{1000 * s.range_noise:g} | {s.threshold:g} | {s.threshold_source} | {s.source} |"
        )


if __name__ == "__main__":
    main()
