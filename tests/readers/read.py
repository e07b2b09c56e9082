"""Reads what was exported with the formats' own libraries, and prints it as JSON for the tests to judge."""

import json
import sys


def usd(asset, over):
    """Primvars of all prims of an asset under an over-layer; an empty asset reads the layer alone."""
    from pxr import Sdf, Usd, UsdGeom

    root = Sdf.Layer.CreateAnonymous(".usda")
    root.subLayerPaths = [over] + ([asset] if asset else [])
    stage = Usd.Stage.Open(root)
    found = {}
    for prim in stage.TraverseAll():
        primvars = {}
        for primvar in UsdGeom.PrimvarsAPI(prim).GetPrimvars():
            value = primvar.Get()
            if primvar.GetTypeName() == Sdf.ValueTypeNames.FloatArray and value is not None:
                primvars[primvar.GetPrimvarName()] = {
                    "interpolation": primvar.GetInterpolation(),
                    "elementSize": primvar.GetElementSize(),
                    "values": list(value),
                }
        points = prim.GetAttribute("points").Get() if prim.IsA(UsdGeom.PointBased) else None
        if points is not None:
            world = UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(Usd.TimeCode.Default())
            points = [list(world.Transform(p)) for p in points]
        found[str(prim.GetPath())] = {"type": prim.GetTypeName(), "primvars": primvars, "points": points}
    return found


def ply(path):
    """Properties and values of a PLY file's vertices."""
    import plyfile

    vertex = plyfile.PlyData.read(path)["vertex"]
    names = [p.name for p in vertex.properties]
    return {"names": names, "values": [[float(row[n]) for n in names] for row in vertex.data]}


def exr(path):
    """The layers of an EXR file: size, and the values of their one channel."""
    import OpenEXR

    parts = OpenEXR.File(path, separate_channels=True).parts
    return [
        {"name": part.name(), "channels": {n: c.pixels.tolist() for n, c in part.channels.items()}}
        for part in parts
    ]


print(json.dumps({"usd": usd, "ply": ply, "exr": exr}[sys.argv[1]](*sys.argv[2:])))
