"""Made gsply_plain.ply, gsply.compressed.ply and gsply_values.npz, with gsply 0.4: another program's 3DGS files."""

from pathlib import Path

import gsply.writer
import numpy as np

HERE = Path(__file__).parent
COUNT = 300  # two chunks of the compressed format, the second one partly filled

rng = np.random.default_rng(7)
quats = rng.normal(size=(COUNT, 4))
values = {
    "means": rng.uniform(-3, 3, (COUNT, 3)),
    "scales": rng.uniform(-6, -1, (COUNT, 3)),  # logarithms
    "quats": quats / np.linalg.norm(quats, axis=1, keepdims=True),
    "opacities": rng.uniform(-4, 4, COUNT),  # logits
    "sh0": rng.uniform(-1.5, 1.5, (COUNT, 3)),
    "shN": rng.uniform(-0.5, 0.5, (COUNT, 8, 3)),  # degree 2
}
values = {name: value.astype(np.float32) for name, value in values.items()}
gsply.writer.write_uncompressed(HERE / "gsply_plain.ply", gsply.GSData.from_arrays(**values))
gsply.writer.write_compressed(HERE / "gsply.compressed.ply", **values)
np.savez_compressed(HERE / "gsply_values.npz", **values)
