"""Published figures that the tables of ablations are compared with."""

from __future__ import annotations

TABLE_S1 = {
    "64": {"control_points": 67, "psnr": 42.65, "ssim": 0.9967, "lpips": 0.0073},
    "128": {"control_points": 132, "psnr": 42.87, "ssim": 0.9968, "lpips": 0.0067},
    "256": {"control_points": 264, "psnr": 43.17, "ssim": 0.9969, "lpips": 0.0061},
    "512": {"control_points": 519, "psnr": 43.31, "ssim": 0.9971, "lpips": 0.0063},
    "1024": {"control_points": 1018, "psnr": 43.51, "ssim": 0.9969, "lpips": 0.0064},
    "2048": {"control_points": 1973, "psnr": 42.63, "ssim": 0.9961, "lpips": 0.0079},
    "4096": {"control_points": 2083, "psnr": 39.88, "ssim": 0.9953, "lpips": 0.0090},
}
"""SC-GS, supplement, Table S1: means over D-NeRF at 400 x 400, by the requested number of control points."""
PUBLISHED_PSNR = {
    "control-points": {"jumpingjacks": 41.13, "hook": 39.87, "mutant": 45.19, "standup": 47.89, "hellwarrior": 42.93,
                       "trex": 41.24, "bouncingballs": 44.91, "mean": 43.31},
    "per-gaussian": {"jumpingjacks": 35.74, "hook": 34.47, "mutant": 41.45, "standup": 41.04, "hellwarrior": 39.07,
                     "trex": 36.37, "bouncingballs": 41.45, "mean": 38.51},
    "hexplane": {"jumpingjacks": 33.59, "hook": 30.99, "mutant": 35.98, "standup": 35.37, "hellwarrior": 31.39,
                 "trex": 32.16, "bouncingballs": 38.59, "mean": 34.01},
    "static": {"jumpingjacks": 20.64, "hook": 21.71, "mutant": 24.53, "standup": 21.91, "hellwarrior": 29.89,
               "trex": 21.93, "bouncingballs": 23.20, "mean": 23.40},
}  # fmt: skip
"""PSNR on D-NeRF. SC-GS, its per-Gaussian baseline and 4D-GS: from the SC-GS paper, at 400 x 400, checkpoint with the
best test score. Static 3D-GS: from the paper of Deformable-3D-GS, at 800 x 800."""
NOTES = {
    "nodes": "Published: SC-GS, Table S1, mean of D-NeRF at 400 x 400, best checkpoint by test score.",
    "motion": "Published, D-NeRF at 400 x 400, best checkpoint by test score: SC-GS, its per-Gaussian baseline, 4D-GS; "
    "static: 3D-GS at 800 x 800.",
    "arap": "EPE and jitter: motion of surface points, in percent of the figure's height, and the share of the "
    "per-Gaussian baseline's.",
    "zoo": "Subjects at 200 x 200. Median and worst: PSNR of the median and the worst held-out image, with the time of "
    "the worst. Missing: share of the true alpha that the render does not cover. Rods: share of the tenths of all rods "
    "whose alpha is within 10 % of the truth.",
}  # fmt: skip
