"""Plays a file in Blender and compares bones' work with the posing of the script; run by a Python that has bpy."""

from __future__ import annotations

import json
import sys

import bpy
import numpy as np

sys.path.insert(0, sys.argv[2])
import blender_play

bpy.ops.wm.read_factory_settings(use_empty=True)
points, splats = blender_play.load(sys.argv[1])
places, degrees = [], []
for frame in (0, 3, 7):
    bpy.context.scene.frame_set(frame)
    points.modifiers["ellipsoids"].show_viewport = False  # leaves the points that the bones move
    graph = bpy.context.evaluated_depsgraph_get()
    shown = points.evaluated_get(graph)
    found = np.empty(3 * len(splats.scales), np.float32)
    shown.data.vertices.foreach_get("co", found)
    matrix = np.array(shown.matrix_world)
    found = found.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]
    points.modifiers["ellipsoids"].show_viewport = True
    graph.update()
    balls = sum(item.is_instance for item in bpy.context.evaluated_depsgraph_get().object_instances)
    means, quats = splats.at(frame / blender_play.FPS)
    places.append(float(np.abs(found - np.stack([means[:, 0], -means[:, 2], means[:, 1]], 1)).max()))
    turns = np.empty(4 * len(means), np.float32)
    points.data.attributes["turn"].data.foreach_get("value", turns)
    turns = blender_play.multiply(np.array(points.matrix_world.to_quaternion()), turns.reshape(-1, 4))
    wanted = blender_play.multiply(blender_play.TO_BLENDER, quats)
    degrees.append(float(2 * np.degrees(np.arccos(np.abs((turns * wanted).sum(1)).clip(0, 1))).max()))
bones = [bone.name for bone in points.find_armature().data.bones]
print(json.dumps({"off": max(places), "degrees": max(degrees), "balls": balls, "bones": bones}))
