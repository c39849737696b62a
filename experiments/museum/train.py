"""Training: the learned road's hours in the library, before any statue is scanned.

python experiments/museum/train.py [folder]      writes family.npz and encoder.npz
"""

import pathlib
import sys
import time

import figures
import jax

from jaxgeom import io, learning

SHAPES, SAMPLES, CODE, WIDTH = 256, 6000, 16, 96
STEPS = 6000


def models():
    """The untrained networks: what `load_weights` fills."""
    key_decoder, key_codes, key_encoder = jax.random.split(jax.random.key(1), 3)
    decoder = learning.Decoder.create(CODE, key=key_decoder, width=WIDTH)
    family = learning.Family.create(SHAPES, decoder, key=key_codes)
    encoder = learning.PointEncoder.create(CODE, key=key_encoder)
    return family, learning.EncodedFamily(encoder, decoder)


def main(folder):
    """Make the lessons, train both networks, save them."""
    began = time.time()
    samples, clouds = figures.lessons(SHAPES, SAMPLES, seed=100)
    print(f"{SHAPES} shapes with {SAMPLES} distances each: {time.time() - began:.0f} s")
    family, pair = models()
    adam = learning.Adam(num_steps=STEPS, rate=3e-3)
    tell = lambda done, loss: done % 1000 or print(f"  step {done}: loss {loss:.4f}")
    jobs = {
        "family": (family, learning.FamilyLoss(clamp=0.1, prior=1e-4), samples),
        "encoder": (pair, learning.EncodedLoss(clamp=0.1), (samples, clouds)),
    }
    for name, (model, loss, data) in jobs.items():
        began = time.time()
        out = learning.train(
            model, loss, data, key=jax.random.key(2), adam=adam, progress=tell
        )
        io.save_weights(folder / f"{name}.npz", out.model)
        last = float(out.losses[-200:].mean())
        print(f"{name}: {time.time() - began:.0f} s, loss {last:.4f}")


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else "."))
