"""What does subspace identification cost, here and elsewhere? The tables of docs/benchmarks.md.

The same records go to this package and to every peer that is installed (the extra ``bench``),
each in a process of its own, on one BLAS thread: processor time of A, B, C and D from data in
memory, peak memory of the process beyond its imports, largest distance of an identified pole
from its true one.

    python docs/benchmarks/bench_moesp.py
    python docs/benchmarks/bench_moesp.py --peer-python other/bin/python --peers slicot-cholesky

Records: a random model with 10 states, 3 inputs, 3 outputs and full A, B, C, D; 15 block rows.

- ``easy``: white inputs, no noise.
- ``noisy``: white inputs, white noise of 1 % on the outputs.
- ``hard``: inputs through a low-pass of fourth order at a tenth of the Nyquist frequency, two
  poles at 0.98, a mode a hundred thousand times weaker than the others, no noise.
- ``large``: as noisy, with 30 states, 5 inputs, 7 outputs and 31 block rows.
"""

import argparse
import csv
import json
import os
import platform
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from datetime import date
from pathlib import Path

THREADS = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
os.environ.update(THREADS)  # before NumPy is imported

import numpy as np  # noqa: E402
from scipy import linalg, optimize, signal  # noqa: E402

SIZES = {"easy": (10, 3, 3, 15), "noisy": (10, 3, 3, 15), "hard": (10, 3, 3, 15)}
SIZES["large"] = (30, 5, 7, 31)  # states, inputs, outputs, block rows
LENGTHS = (2_000, 20_000, 200_000, 2_000_000)
LONGEST = 20.0  # seconds that a peer may be expected to take for ten times the length
GROWTH = 15.0  # of the cost from one length to the next
MEGABYTE = 1e6


# ---- records -------------------------------------------------------------------------------


def true_poles(kind, n_states, rng):
    """Poles between 0.5 and 0.97 in size, in pairs; two at 0.98 in the hard case."""
    n_pairs = (n_states - 2 * (kind == "hard")) // 2
    pairs = rng.uniform(0.5, 0.97, n_pairs) * np.exp(1j * rng.uniform(0.1, 2.5, n_pairs))
    return pairs, [0.98, 0.98] if kind == "hard" else []


def record(kind, n_samples, seed):
    """Inputs, outputs and true poles."""
    n, m, n_outputs, _ = SIZES[kind]
    rng = np.random.default_rng(seed)
    pairs, real = true_poles(kind, n, rng)
    B, C = rng.standard_normal((n, m)), rng.standard_normal((n_outputs, n))
    D = rng.standard_normal((n_outputs, m))
    if kind == "hard":
        C[:, 2 * len(pairs) - 2 : 2 * len(pairs)] *= 1e-5
    u = rng.standard_normal((n_samples, m))
    if kind == "hard":
        u = signal.lfilter(*signal.butter(4, 0.1), u, axis=0)
    y = u @ D.T
    for i, z in enumerate(pairs):  # x = s + j q, s and q the states of a rotation
        pole = (B[2 * i] + 1j * B[2 * i + 1]) @ u.T
        x = np.append(0.0, signal.lfilter([1.0], [1.0, -z], pole)[:-1])
        y += np.outer(x.real, C[:, 2 * i]) + np.outer(x.imag, C[:, 2 * i + 1])
    for i, z in enumerate(real, start=2 * len(pairs)):
        x = np.append(0.0, signal.lfilter([1.0], [1.0, -z], u @ B[i])[:-1])
        y += np.outer(x, C[:, i])
    if kind in ("noisy", "large"):
        y += 0.01 * y.std(axis=0) * rng.standard_normal(y.shape)
    return u, y, np.concatenate([pairs, pairs.conj(), real])


def pole_error(A, poles):
    """Largest distance between poles, paired one to one."""
    distance = np.abs(np.asarray(poles)[:, None] - linalg.eigvals(A))
    return float(distance[optimize.linear_sum_assignment(distance)].max())


# ---- peers: each prepares its input, and returns a function that identifies A --------------


def kernel(u, y, n, block_rows):
    """The pure functions below MOESPRegressor."""
    from sklearn_hd.algorithms.subspace.input_matrices import input_matrices
    from sklearn_hd.algorithms.subspace.projections import state_matrices

    subspace = kernel_subspace(u, y, block_rows)

    def identify():
        A, C = state_matrices(*subspace(), n, y.shape[1])
        input_matrices(A, C, [u], [y], True)
        return A

    return identify


def kernel_state_matrices(u, y, n, block_rows):
    """The same, for A and C alone."""
    from sklearn_hd.algorithms.subspace.projections import state_matrices

    subspace = kernel_subspace(u, y, block_rows)
    return lambda: state_matrices(*subspace(), n, y.shape[1])[0]


def kernel_subspace(u, y, block_rows):
    """Singular vectors and values from the triangular factor, which nothing keeps."""
    from sklearn_hd.algorithms.subspace.hankel import hankel_factor
    from sklearn_hd.algorithms.subspace.projections import observability_subspace

    m = u.shape[1]
    return lambda: observability_subspace(hankel_factor([u], [y], block_rows), block_rows, m)


def estimator(u, y, n, block_rows):
    """MOESPRegressor.fit on DataFrames."""
    import pandas as pd

    from sklearn_hd import MOESPRegressor

    time_index = pd.Index(0.01 * np.arange(len(u)), name="time")
    X = pd.DataFrame(u, time_index, [f"u{i}" for i in range(u.shape[1])])
    Y = pd.DataFrame(y, time_index, [f"y{i}" for i in range(y.shape[1])])
    model = MOESPRegressor(order=n, block_rows=block_rows, feedthrough=True)
    return lambda: model.fit(X, Y).model_.A


def slicot(algorithm):
    def prepare(u, y, n, block_rows):
        from ctrlsys import ib01ad, ib01bd

        u, y = np.asfortranarray(u), np.asfortranarray(y)
        m, n_outputs = u.shape[1], y.shape[1]

        def identify():
            R = ib01ad(
                "M", algorithm, "N", "O", "N", "N", block_rows, m, n_outputs, u, y, 0.0, -1.0
            )[1]
            shape = block_rows, n, m, n_outputs, len(u)
            if n + m < 20:
                return ib01bd("C", "A", "N", *shape, R, 0.0)[0]
            return ib01bd("M", "A", "N", *shape, R, 0.0)[0]  # "C" refuses its own workspace

        return identify

    return prepare


def sippy(u, y, n, block_rows):
    from sippy_unipi import system_identification

    def identify():
        return system_identification(
            y.T, u.T, "MOESP", SS_f=block_rows, SS_fixed_order=n, SS_D_required=True
        ).A

    return identify


def nfoursid(u, y, n, block_rows):
    import pandas as pd
    from nfoursid.nfoursid import NFourSID

    inputs, outputs = ([f"{s}{i}" for i in range(z.shape[1])] for s, z in (("u", u), ("y", y)))
    frame = pd.DataFrame(np.hstack([u, y]), columns=inputs + outputs)

    def identify():
        peer = NFourSID(frame, outputs, inputs, num_block_rows=block_rows)
        peer.subspace_identification()
        return peer.system_identification(rank=n)[0].a

    return identify


def llsi(u, y, n, block_rows):
    """Its window follows from the order alone; not made for several inputs and outputs."""
    import llsi as peer

    inputs, outputs = ([f"{s}{i}" for i in range(z.shape[1])] for s, z in (("u", u), ("y", y)))
    series = dict(zip(inputs + outputs, [*u.T, *y.T], strict=True))

    def identify():
        data = peer.SysIdData(Ts=1.0, **series)
        return peer.sysid(data, outputs, inputs, (n,), method="po-moesp").A

    return identify


def psid(u, y, n, block_rows):
    from PSID import IPSID

    return lambda: IPSID(y, U=u, nx=n, n1=0, i=block_rows).A


def octave(u, y, n, block_rows):
    """The control package's moesp (SLICOT, compiled); the time is Octave's own."""
    from scipy.io import loadmat, savemat

    folder = Path(tempfile.mkdtemp())
    savemat(folder / "record.mat", {"u": u, "y": y})
    script = (
        "pkg load control; load record.mat; data = iddata(y, u); before = cputime; "
        f"sys = moesp(data, {n}, 's', {block_rows}); seconds = cputime - before; A = sys.a; "
        "save -v6 found.mat A seconds"
    )

    def identify():
        command = ["octave-cli", "--norc", "--quiet", "--eval", script]
        subprocess.run(command, cwd=folder, check=True, capture_output=True)
        found = loadmat(folder / "found.mat")
        identify.seconds = float(found["seconds"].item())
        return found["A"]

    return identify


PEERS = {
    "kernel": kernel,
    "kernel, A and C": kernel_state_matrices,
    "MOESPRegressor": estimator,
    "slicot-cholesky": slicot("C"),
    "slicot-qr": slicot("Q"),
    "sippy": sippy,
    "nfoursid": nfoursid,
    "llsi": llsi,
    "psid": psid,
    "octave": octave,
}
OURS = ("kernel", "kernel, A and C", "MOESPRegressor")


# ---- one peer, one record: in a process of its own -------------------------------------------


def peak_memory():
    """Largest resident size of this process so far, bytes."""
    status = Path("/proc/self/status")
    if status.exists():  # there ru_maxrss begins with the size of the process that started this one
        found = re.search(r"VmHWM:\s+(\d+) kB", status.read_text(encoding="utf-8"))
        return 1024 * int(found.group(1))
    unit = 1 if sys.platform == "darwin" else 1024
    return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def work(peer, folder, kind, repeats):
    """Print seconds, bytes and error of one peer as JSON."""
    n, _, _, block_rows = SIZES[kind]
    small = np.random.default_rng(0).standard_normal((40 * block_rows, 12))
    PEERS[peer](small[:, :5], small[:, 5:], 1, 2)  # imports
    imports = peak_memory()
    u, y = (np.load(Path(folder) / f"{name}.npy") for name in "uy")
    poles = np.load(Path(folder) / "poles.npy")
    identify = PEERS[peer](u, y, n, block_rows)
    seconds, begun = [], time.process_time()
    while len(seconds) < repeats and (not seconds or time.process_time() - begun < LONGEST / 2):
        before = time.process_time()
        A = identify()
        seconds.append(getattr(identify, "seconds", time.process_time() - before))
    print(
        json.dumps(
            {
                "seconds": float(np.median(seconds)),
                "runs": len(seconds),
                "memory": peak_memory() - imports,
                "data_bytes": u.nbytes + y.nbytes,
                "error": pole_error(A, poles),
            }
        )
    )


def measure(peer, folder, kind, options):
    """The result of one peer as a dict; its last line of complaint where it has none."""
    python = sys.executable if peer in OURS else options.peer_python
    command = [python, __file__, "--work", peer, str(folder), kind, str(options.repeats)]
    environment = {**os.environ, **THREADS, "MPLBACKEND": "Agg"}
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, env=environment, timeout=10 * LONGEST
        )
    except subprocess.TimeoutExpired:
        return {"failure": f"more than {10 * LONGEST:g} s"}
    if done.returncode == 0:
        return json.loads(done.stdout.strip().splitlines()[-1])
    lines = done.stderr.strip().splitlines()
    return {"failure": lines[-1] if lines else f"ended with {done.returncode}"}


# ---- the tables ---------------------------------------------------------------------------


def study(options):
    """Measure every peer on every record, the short ones first."""
    rows, given_up = [], set()
    for kind in options.kinds:
        lengths = [20_000] if kind == "large" else options.lengths
        for n_samples in lengths:
            with tempfile.TemporaryDirectory() as folder:
                values = record(kind, n_samples, options.seed)
                for name, value in zip(("u", "y", "poles"), values, strict=True):
                    np.save(Path(folder) / f"{name}.npy", value)
                for peer in options.peers:
                    if (peer, kind) in given_up or (
                        peer == "octave" and not shutil.which("octave-cli")
                    ):
                        continue
                    found = measure(peer, folder, kind, options)
                    rows.append({"data": kind, "n_samples": n_samples, "peer": peer, **found})
                    print(line(rows[-1]), flush=True)
                    if "failure" in found or GROWTH * found["seconds"] > LONGEST:
                        given_up.add((peer, kind))
    return rows


def line(row):
    """One row as text."""
    head = f"{row['data']:6} {row['n_samples']:8} {row['peer']:16}"
    if "failure" in row:
        return f"{head} {row['failure'][:70]}"
    return (
        f"{head} {1e3 * row['seconds']:10.2f} ms  {row['memory'] / MEGABYTE:8.1f} MB  "
        f"error {row['error']:.1e}  ({row['runs']} runs)"
    )


def save(rows, folder):
    """Table and plot of cost against length."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    folder.mkdir(parents=True, exist_ok=True)
    names = [
        "data",
        "n_samples",
        "peer",
        "seconds",
        "runs",
        "memory",
        "data_bytes",
        "error",
        "failure",
    ]
    with open(folder / "moesp.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
    kinds = [kind for kind in ("easy", "noisy", "hard") if any(r["data"] == kind for r in rows)]
    if not kinds:
        return
    figure, axes = plt.subplots(
        1, len(kinds), figsize=(4 * len(kinds) + 1, 4), sharey=True, squeeze=False
    )
    lines = {}  # by peer, in whichever panel it comes first
    for axis, kind in zip(axes[0], kinds, strict=True):
        for k, peer in enumerate(dict.fromkeys(row["peer"] for row in rows)):
            points = [
                (row["n_samples"], row["seconds"])
                for row in rows
                if row["data"] == kind and row["peer"] == peer and "failure" not in row
            ]
            if points:
                style = "o-" if peer in OURS else "s--"
                drawn = axis.loglog(*zip(*points, strict=True), style, ms=4, color=f"C{k}")
                lines.setdefault(peer, drawn[0])
        axis.set(title=kind, xlabel="samples")
        axis.grid(alpha=0.3)
    axes[0, 0].set_ylabel("processor time, s")
    axes[0, -1].legend(
        lines.values(), lines.keys(), fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0)
    )
    figure.tight_layout()
    figure.savefig(folder / "moesp.png", dpi=150, bbox_inches="tight")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kinds", nargs="+", default=list(SIZES), choices=list(SIZES))
    parser.add_argument("--lengths", nargs="+", type=int, default=list(LENGTHS))
    parser.add_argument("--peers", nargs="+", default=list(PEERS), choices=list(PEERS))
    parser.add_argument("--peer-python", default=sys.executable, help="interpreter of the peers")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--seed", type=int, default=20)
    parser.add_argument("--output", type=Path, default=Path("results"))
    options = parser.parse_args()
    print(f"{date.today()}, {platform.machine()}, {os.cpu_count()} cores, one BLAS thread")
    save(study(options), options.output)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--work"]:
        work(*sys.argv[2:5], int(sys.argv[5]))
    else:
        main()
