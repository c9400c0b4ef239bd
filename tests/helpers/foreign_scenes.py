"""A small scene in the layouts of other programs: a textured wall that a camera passes, with its depth."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import av
import cv2
import numpy as np
from scipy.spatial.transform import Rotation

WIDTH, HEIGHT, COUNT = 48, 36, 6
WALL = 3.0
"""Distance of the wall, y in the world (z up)."""
K = np.array([[50.0, 0.0, 24.0], [0.0, 50.0, 18.0], [0.0, 0.0, 1.0]])
Y_UP = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
OPENGL = np.diag([1.0, -1, -1, 1])


class Wall(NamedTuple):
    viewmats: np.ndarray
    """[V, 4, 4] world-to-camera, OpenCV, z up."""
    images: np.ndarray
    """[V, H, W, 3] uint8"""
    depths: np.ndarray
    """[V, H, W]"""


def wall() -> Wall:
    """Cameras at y = 0 that look along +y and turn a little."""
    views, images, depths = [], [], []
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], -1)
    for index in range(COUNT):
        axes = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # right, down, forward in the world
        turn = Rotation.from_euler("y", 4.0 * index - 10.0, degrees=True).as_matrix()
        viewmat = np.eye(4)
        viewmat[:3, :3] = turn @ axes
        viewmat[:3, 3] = -viewmat[:3, :3] @ np.array([0.2 * index, 0.0, 1.0 + 0.05 * index])
        directions = rays @ viewmat[:3, :3]
        depth = WALL / directions[..., 1]
        places = directions * depth[..., None] + np.array([0.2 * index, 0.0, 1.0 + 0.05 * index])
        color = 0.5 + 0.5 * np.sin(places[..., [0, 2, 0]] * [3.0, 4.0, 7.0])
        views.append(viewmat)
        images.append(np.rint(color * 255).astype(np.uint8))
        depths.append(depth)
    return Wall(np.stack(views), np.stack(images), np.stack(depths))


def arkit_pose(viewmat: np.ndarray) -> np.ndarray:
    """[4, 4] camera-to-world with OpenGL's axes in a world with y up."""
    return np.linalg.inv(Y_UP) @ np.linalg.inv(viewmat) @ OPENGL


def _save(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))


def write_megasam(folder: Path) -> Path:
    made = wall()
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(
        folder / "scene_sgd_cvd_hr.npz",
        images=made.images,
        depths=np.float16(made.depths),
        intrinsic=np.float32(K),
        cam_c2w=np.linalg.inv(made.viewmats).astype(np.float32),
    )
    return folder / "scene_sgd_cvd_hr.npz"


def write_vggt(folder: Path) -> Path:
    """With an object array, as its demo writes one: it is never read."""
    made = wall()
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(
        folder / "predictions.npz",
        images=np.moveaxis(made.images, 3, 1).astype(np.float32) / 255,
        depth=made.depths.astype(np.float32)[..., None],
        depth_conf=1 + np.random.default_rng(0).random(made.depths.shape, np.float32),
        extrinsic=made.viewmats[:, :3].astype(np.float32),
        intrinsic=np.tile(np.float32(K), (COUNT, 1, 1)),
        pose_enc_list=np.array(None, dtype=object),
    )
    return folder / "predictions.npz"


def write_depth_anything(folder: Path, images: str = "image", depth: str = "depth") -> Path:
    made = wall()
    folder.mkdir(parents=True, exist_ok=True)
    named: dict[str, Any] = {images: made.images, depth: made.depths.astype(np.float32)}
    np.savez_compressed(
        folder / "results.npz",
        **named,
        conf=1 + np.random.default_rng(1).random(made.depths.shape, np.float32),
        extrinsics=made.viewmats[:, :3].astype(np.float32),
        intrinsics=np.tile(np.float32(K), (COUNT, 1, 1)),
    )
    return folder / "results.npz"


def world_points(made: Wall) -> np.ndarray:
    """[V, H, W, 3] what the pixels show, in the world."""
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    local = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(K).T * made.depths[..., None]
    return np.stack([(one - pose[:3, 3]) @ pose[:3, :3] for one, pose in zip(local, made.viewmats)])


def write_map_anything(folder: Path) -> Path:
    """VGGT's names for poses from camera to world."""
    made = wall()
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(
        folder / "predictions.npz",
        extrinsic=np.linalg.inv(made.viewmats).astype(np.float32),
        intrinsic=np.tile(np.float32(K), (COUNT, 1, 1)),
        world_points=world_points(made).astype(np.float32),
        conf=1 + np.random.default_rng(0).random(made.depths.shape, np.float32),
        depth=made.depths.astype(np.float32)[..., None],
        images=made.images.astype(np.float32) / 255,
        final_mask=np.ones(made.depths.shape, bool),
    )
    return folder / "predictions.npz"


def write_spatial_tracker(folder: Path) -> Path:
    made = wall()
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(
        folder / "result.npz",
        coords=np.zeros((COUNT, 20, 3), np.float32),
        extrinsics=made.viewmats.astype(np.float32),
        intrinsics=np.tile(np.float32(K), (COUNT, 1, 1)),
        depths=made.depths.astype(np.float32),
        video=np.moveaxis(made.images, 3, 1).astype(np.float32) / 255,
        visibs=np.ones((COUNT, 20, 1), np.float32),
        unc_metric=0.5 + 0.5 * np.random.default_rng(0).random(made.depths.shape, np.float32),
    )
    return folder / "result.npz"


def write_pi3(folder: Path) -> Path:
    """With points of the world in place of depth and intrinsics, and the first columns unsure."""
    made = wall()
    folder.mkdir(parents=True, exist_ok=True)
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], -1)
    poses = np.linalg.inv(made.viewmats)
    points = np.einsum("nij,nhwj->nhwi", poses[:, :3, :3], rays * made.depths[..., None]) + poses[:, None, None, :3, 3]
    confidence = 0.5 + 0.5 * np.random.default_rng(1).random((*made.depths.shape, 1), np.float32)
    confidence[:, :, :2] = 0.0
    np.savez(
        folder / "predictions.npz",
        images=made.images.astype(np.float32) / 255,
        points=points.astype(np.float32),
        conf=confidence,
        camera_poses=poses.astype(np.float32),
    )
    return folder / "predictions.npz"


def write_cut3r(folder: Path) -> Path:
    made = wall()
    for index, viewmat in enumerate(made.viewmats):
        name = f"{index:06d}"
        for kind in ("camera", "depth", "conf"):
            (folder / kind).mkdir(parents=True, exist_ok=True)
        _save(folder / f"color/{name}.png", made.images[index])
        np.save(folder / f"depth/{name}.npy", made.depths[index].astype(np.float32))
        np.save(folder / f"conf/{name}.npy", 1 + made.depths[index].astype(np.float32))
        np.savez(
            folder / f"camera/{name}.npz",
            pose=np.linalg.inv(viewmat).astype(np.float32),
            intrinsics=K.astype(np.float32),
        )
    return folder


def write_streaming(folder: Path) -> Path:
    made = wall()
    (folder / "results_output").mkdir(parents=True)
    for index in range(COUNT):
        np.savez_compressed(
            folder / f"results_output/frame_{index}.npz",
            image=made.images[index],
            depth=made.depths[index].astype(np.float32),
            conf=1 + made.depths[index].astype(np.float32),
            intrinsics=K.astype(np.float32),
        )
    rows = np.linalg.inv(made.viewmats).reshape(COUNT, 16)
    (folder / "camera_poses.txt").write_text("".join(" ".join(str(v) for v in row) + "\n" for row in rows))
    np.savetxt(folder / "intrinsic.txt", np.tile(K[[0, 1, 0, 1], [0, 1, 2, 2]], (COUNT, 1)))
    return folder


def write_uni4d(folder: Path) -> Path:
    """With the file of the fused points beside the frames."""
    made = wall()
    folder.mkdir(parents=True)
    for index, viewmat in enumerate(made.viewmats):
        pose = np.linalg.inv(viewmat).astype(np.float32)
        view = {"R": pose[:3, :3], "t": pose[:3, 3:], "K": K.astype(np.float32)}
        disparity = (1.0 / made.depths[index]).astype(np.float32)
        np.savez_compressed(folder / f"{index:04d}.npz", img=made.images[index], disp=disparity, **view)
    np.savez_compressed(folder / "fused_4d.npz", static_points=np.zeros((4, 3)), Ks=np.tile(K, (COUNT, 1, 1)))
    return folder


def write_monst3r(folder: Path) -> Path:
    made = wall()
    folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for index, viewmat in enumerate(made.viewmats):
        pose = np.linalg.inv(viewmat)
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        rows.append(" ".join(str(v) for v in (float(index), *pose[:3, 3], w, x, y, z)))
        _save(folder / f"frame_{index:04d}.png", made.images[index])
        np.save(folder / f"frame_{index:04d}.npy", np.float32(made.depths[index]))
        np.save(folder / f"conf_{index}.npy", 1 + np.float32(made.depths[index]))
    (folder / "pred_traj.txt").write_text("\n".join(rows) + "\n")
    np.savetxt(folder / "pred_intrinsics.txt", np.tile(K.ravel(), (COUNT, 1)), fmt="%.6f")
    return folder


def write_polycam(folder: Path) -> Path:
    made = wall()
    base = folder / "keyframes"
    for index, viewmat in enumerate(made.viewmats):
        stem, pose = f"{1_000_000 + 33_333 * index}", arkit_pose(viewmat)
        _save(base / f"corrected_images/{stem}.png", made.images[index])
        values = {"fx": 100.0, "fy": 100.0, "cx": 48.0, "cy": 36.0, "width": 96, "height": 72, "blur_score": 90.0}
        values |= {f"t_{row}{column}": pose[row, column] for row in range(3) for column in range(4)}
        (base / "corrected_cameras").mkdir(exist_ok=True)
        (base / f"corrected_cameras/{stem}.json").write_text(json.dumps(values))
        small = cv2.resize(made.depths[index], (24, 18), interpolation=cv2.INTER_AREA)
        (base / "depth").mkdir(exist_ok=True)
        (base / "confidence").mkdir(exist_ok=True)
        cv2.imwrite(str(base / f"depth/{stem}.png"), np.rint(small * 1000).astype(np.uint16))
        cv2.imwrite(str(base / f"confidence/{stem}.png"), np.full_like(small, 255, np.uint8))
    return folder


def write_exr(path: Path, channels: dict[str, np.ndarray]) -> None:
    """Write an OpenEXR file, if the package is there."""
    try:
        import OpenEXR
    except ImportError:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, channels) as file:
        file.write(str(path))


def write_record3d(folder: Path) -> Path:
    made = wall()
    poses = []
    for index, viewmat in enumerate(made.viewmats):
        pose = arkit_pose(viewmat)
        poses.append([*Rotation.from_matrix(pose[:3, :3]).as_quat(), *pose[:3, 3]])
        _save(folder / f"rgb/{index}.png", made.images[index])
        write_exr(folder / f"depth/{index}.exr", {"R": made.depths[index].astype(np.float16)})
    content = {"poses": poses, "K": K.T.ravel().tolist(), "w": WIDTH, "h": HEIGHT, "fps": 30}
    content["frameTimestamps"] = [0.5 + index / 30 for index in range(COUNT)]
    (folder / "metadata.json").write_text(json.dumps(content))
    return folder


def write_scanner(folder: Path) -> Path:
    """With a frame that has no image, as most have none."""
    made = wall()
    folder.mkdir(parents=True, exist_ok=True)
    for index, viewmat in enumerate(made.viewmats):
        stem = f"{index:05d}"
        _save(folder / f"frame_{stem}.png", made.images[index])
        cv2.imwrite(str(folder / f"depth_{stem}.png"), np.rint(made.depths[index] * 1000).astype(np.uint16))
        cv2.imwrite(str(folder / f"conf_{stem}.png"), np.full_like(made.depths[index], 2, np.uint8))
        values = {"cameraPoseARFrame": arkit_pose(viewmat).ravel().tolist(), "intrinsics": K.ravel().tolist()}
        (folder / f"frame_{stem}.json").write_text(json.dumps({**values, "time": 10.0 + index / 60}))
    (folder / "frame_00099.json").write_text("{}")
    return folder


def write_vipe(folder: Path, name: str = "film", camera: str = "PINHOLE", unposed: int | None = None) -> Path:
    """With the record of a run, a pickle, which is never read."""
    made, posed = wall(), [number for number in range(COUNT) if number != unposed]
    for kind in ("rgb", "pose", "intrinsics", "depth", "vipe"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    with av.open(str(folder / f"rgb/{name}.mp4"), "w") as out:
        stream = out.add_stream("libx264rgb", rate=24, options={"crf": "0"})
        stream.width, stream.height, stream.pix_fmt = made.images.shape[2], made.images.shape[1], "rgb24"
        for image in made.images:
            out.mux(stream.encode(av.VideoFrame.from_ndarray(image, "rgb24")))
        out.mux(stream.encode())
    poses = np.linalg.inv(made.viewmats).astype(np.float32)
    np.savez(folder / f"pose/{name}.npz", data=poses[posed], inds=np.array(posed))
    lens = np.tile(np.float32(K[[0, 1, 0, 1], [0, 1, 2, 2]]), (COUNT, 1))
    np.savez(folder / f"intrinsics/{name}.npz", data=lens, inds=np.arange(COUNT))
    (folder / f"intrinsics/{name}_camera.txt").write_text("".join(f"{i}: {camera}\n" for i in range(COUNT)))
    (folder / f"vipe/{name}_info.pkl").write_bytes(b"\x80\x04.")
    with zipfile.ZipFile(folder / f"depth/{name}.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for number in range(COUNT):
            write_exr(folder / "map.exr", {"Z": made.depths[number].astype(np.float16)})
            if (folder / "map.exr").is_file():
                archive.write(folder / "map.exr", f"{number:05d}.exr")
    return folder


WRITERS = {
    "MegaSaM": write_megasam,
    "VGGT": write_vggt,
    "MapAnything": write_map_anything,
    "SpatialTrackerV2": write_spatial_tracker,
    "Depth Anything 3": write_depth_anything,
    "Pi3": write_pi3,
    "MonST3R": write_monst3r,
    "ViPE": write_vipe,
    "CUT3R": write_cut3r,
    "DA3-Streaming": write_streaming,
    "Uni4D": write_uni4d,
    "Polycam": write_polycam,
    "Record3D": write_record3d,
    "3D Scanner App": write_scanner,
}
