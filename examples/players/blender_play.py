"""Play a skinned .glb in Blender (4.2 or newer): joints become bones to be posed, and every Gaussian an ellipsoid.

    blender --python blender_play.py -- scene.glb

The importer of Blender makes the bones, and binds points to them. This script adds what it leaves out: an ellipsoid for
each Gaussian, of its size, colour and opacity, that turns with the bones in every frame, whoever poses them.
"""

from __future__ import annotations

import sys
from pathlib import Path

import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))
from skinned_splats import SkinnedSplats, blend, multiply

FPS = 30
SIGMAS = 1.5
"""Radius of an ellipsoid in standard deviations."""
TO_BLENDER = np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0])
"""Turn from y up to z up."""


def load(path: str) -> tuple[bpy.types.Object, SkinnedSplats]:
    """Import a file; return the object of its points, whose modifiers draw the ellipsoids."""
    splats, before = SkinnedSplats(path), set(bpy.data.objects)
    bpy.context.scene.render.fps = FPS  # before the importer turns seconds into frames
    bpy.ops.import_scene.gltf(filepath=path)
    points = next(o for o in bpy.data.objects if o not in before and o.find_armature() is not None)
    points.rotation_mode = "QUATERNION"
    points.rotation_quaternion = (1.0, 0.0, 0.0, 0.0)  # the skin alone places the points
    add(points, "scale", "FLOAT_VECTOR", "vector", SIGMAS * splats.scales)
    add(points, "splat_color", "FLOAT_COLOR", "color", np.column_stack([splats.colors**2.2, splats.opacities]))
    add(points, "turn", "QUATERNION", "value", np.zeros((len(splats.scales), 4)))
    ellipsoids = points.modifiers.new("ellipsoids", "NODES")
    ellipsoids.node_group = node_group(material())
    bpy.app.handlers.frame_change_post.append(lambda *_: turn(points, splats))
    bpy.context.scene.frame_start = 0
    bpy.context.scene.frame_end = round(FPS * float(splats.seconds[-1]))
    bpy.context.scene.frame_set(0)
    return points, splats


def add(points: bpy.types.Object, name: str, kind: str, field: str, values: np.ndarray) -> None:
    attribute = points.data.attributes.new(name, kind, "POINT")
    attribute.data.foreach_set(field, np.ascontiguousarray(values, np.float32).reshape(-1))


def turn(points: bpy.types.Object, splats: SkinnedSplats) -> None:
    """Turn all ellipsoids as their bones are turned since the bind pose, in the space of the armature."""
    rig, turns = points.find_armature(), np.empty((len(splats.names), 4))
    for row, name in enumerate(splats.names):
        bone = rig.pose.bones[name]
        turns[row] = (bone.matrix @ bone.bone.matrix_local.inverted()).to_quaternion()
    own = multiply(TO_BLENDER, splats.quats)
    values = multiply(blend(splats.weights, turns[splats.joints]), own)
    points.data.attributes["turn"].data.foreach_set("value", values.astype(np.float32).reshape(-1))
    points.data.update()


def node_group(surface: bpy.types.Material) -> bpy.types.NodeTree:
    """Return nodes that put a ball on every point, turned and stretched by its attributes."""
    tree = bpy.data.node_groups.new("ellipsoids", "GeometryNodeTree")
    tree.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    new, link = tree.nodes.new, tree.links.new
    entry, leave = new("NodeGroupInput"), new("NodeGroupOutput")
    ball, place = new("GeometryNodeMeshIcoSphere"), new("GeometryNodeInstanceOnPoints")
    ball.inputs["Subdivisions"].default_value = 2
    paint = new("GeometryNodeSetMaterial")
    paint.inputs["Material"].default_value = surface
    size, turned = new("GeometryNodeInputNamedAttribute"), new("GeometryNodeInputNamedAttribute")
    size.data_type, turned.data_type = "FLOAT_VECTOR", "QUATERNION"
    size.inputs["Name"].default_value, turned.inputs["Name"].default_value = "scale", "turn"
    link(entry.outputs["Geometry"], place.inputs["Points"])
    link(ball.outputs["Mesh"], paint.inputs["Geometry"])
    link(paint.outputs["Geometry"], place.inputs["Instance"])
    link(size.outputs["Attribute"], place.inputs["Scale"])
    link(turned.outputs["Attribute"], place.inputs["Rotation"])
    link(place.outputs["Instances"], leave.inputs["Geometry"])
    return tree


def material() -> bpy.types.Material:
    """Return a material that shines in the Gaussian's colour, as opaque as it is."""
    made = bpy.data.materials.new("splat")
    made.use_nodes = True
    tree = made.node_tree
    tree.nodes.clear()
    color, shine = tree.nodes.new("ShaderNodeAttribute"), tree.nodes.new("ShaderNodeEmission")
    clear, mix = tree.nodes.new("ShaderNodeBsdfTransparent"), tree.nodes.new("ShaderNodeMixShader")
    leave = tree.nodes.new("ShaderNodeOutputMaterial")
    color.attribute_name, color.attribute_type = "splat_color", "INSTANCER"
    tree.links.new(color.outputs["Color"], shine.inputs["Color"])
    tree.links.new(color.outputs["Alpha"], mix.inputs["Fac"])
    tree.links.new(clear.outputs["BSDF"], mix.inputs[1])
    tree.links.new(shine.outputs["Emission"], mix.inputs[2])
    tree.links.new(mix.outputs["Shader"], leave.inputs["Surface"])
    return made


if __name__ == "__main__":
    load(sys.argv[-1])
