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
STEPS, ENCODER_STEPS = 6000, 4000


def models():
    """The untrained networks: what `load_weights` fills."""
    key_decoder, key_codes, key_encoder = jax.random.split(jax.random.key(1), 3)
    decoder = learning.Decoder.create(CODE, key=key_decoder, width=WIDTH)
    family = learning.Family.create(SHAPES, decoder, key=key_codes)
    encoder = learning.PointEncoder.create(CODE, key=key_encoder)
    return family, learning.EncodedFamily(encoder, decoder)


def main(folder):
    """Make the lessons, train both networks, save them."""
    folder.mkdir(parents=True, exist_ok=True)
    began = time.time()
    samples, clouds = figures.lessons(SHAPES, SAMPLES, seed=100)
    print(f"{SHAPES} shapes with {SAMPLES} distances each: {time.time() - began:.0f} s")
    family, pair = models()
    loss = learning.FamilyLoss(clamp=0.1, prior=1e-4)
    adam = learning.Adam(num_steps=STEPS, rate=3e-3)
    family = taught(folder / "family.npz", family, loss, samples, adam)
    train_encoder(folder, family, pair, samples, clouds)


def train_encoder(folder, family, pair, samples, clouds):
    """The encoder, with the decoder of the family to start from.

    From a blank decoder it does not learn: both settle on the mean figure.
    """
    pair = learning.EncodedFamily(pair.encoder, family.decoder)
    loss = learning.EncodedLoss(clamp=0.1)
    adam = learning.Adam(num_steps=ENCODER_STEPS, rate=1e-3)
    taught(folder / "encoder.npz", pair, loss, (samples, clouds), adam)


def taught(path, model, loss, data, adam):
    """The model after training, saved."""
    began = time.time()
    tell = lambda done, value: done % 1000 or print(f"  step {done}: {value:.4f}")
    key = jax.random.key(2)
    out = learning.train(model, loss, data, key=key, adam=adam, progress=tell)
    io.save_weights(path, out.model)
    last = float(out.losses[-200:].mean())
    print(f"{path.name}: {time.time() - began:.0f} s, loss {last:.4f}")
    return out.model


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else "."))
