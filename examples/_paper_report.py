"""What ``reproduce_paper.py`` says beside its tables."""

from collections import Counter

import pandas as pd

TABLE_NOTES = """\
e is Eq. 27, in percent; noise rows are the rms over the seeds, beside the largest and the
Cramér-Rao bound. Noise: white, on the outputs, 1/20 of each column's standard deviation over
the record ("SNR 20" taken as a ratio). The paper prints neither sampling nor width nor
amplitude of its doublet; here 64 samples a period, 10 + 10 periods, from period 132 (5 s) of
220, and from period 5 of 60 period by period. "pair": a second record begins downwards, and
the odd part of both is identified. The paper's one figure for NLTP stands beside all of these.
A_exact is that of the trim which the data share (512 harmonics); the paper's is that of a
trim of two harmonics (-54.747 where this one has {entry:.3f}).

Why the ways differ on LTP and NLTP data:
- Three modes kept. One member of each family is kept, one of the copies λ + jpω. No three
  members are the modes of the three-state decomposition, which is an approximation itself.
- Others residualized. The copies have a static gain, which becomes a feedthrough D. The known
  form has D = 0. The matcher then weighs all frequencies alike, cannot meet D, and warns.
- Period by period. It is not bound to one member of each family: it finds F(ψ) first.
"""
ORDER_NOTES = """\
Order by the gap: {ours} where the paper has 3, 11, 7 and 9 (lti, lti-signal, ltp, nltp).
An analyzer adds copies of the genuine modes at multiples of jω and its window's own memory,
and how many of them the rows resolve depends on how often a period they are read and on the
window, which the paper does not print. The NLTP values fall steadily to the floor, without a
clear gap. On LTI-signal and LTP data the order found without noise is
"""
NOISE_NOTES = """\
bound_percent is the Cramér-Rao bound on the rms of e for this record: on the route "paper" of
the three-state model (A and B free, x0 and input known), the next column the same with one
free entry in B; on the route "synchronous" of a periodic model with four harmonics in F and
one in G. Those harmonics leave a bias of 0.9 % (F has kinks) beside the noise. The three-state
model has a bias on LTP data too, and its bound is not that of other models. With --full, noise
on "both" is on the input too; "allowed for" tells its size to the fit (total least squares).
The paper's 0.0767 % (lti+noise) and 0.4514 % (ltp+noise) lie below the bounds of this record:
its own must have held more (length, rate, or another meaning of SNR 20).
"""


def show(table, digits):
    """A table in text, numbers to some digits, nothing where there is none."""

    def number(value):
        return "" if pd.isna(value) else f"{value:.{digits}g}"

    print(table.to_string(index=False, float_format=number, na_rep=""), end="\n\n")


def report_warnings(runs):
    print("What the package warned of in these fits:")
    for case, case_runs in runs.items():
        counts = Counter(message for r in case_runs for message in r.warned)
        for message, count in counts.items():
            print(f"  {case.data}, {case.subsystem} ({count} of {len(case_runs)}): {message}")
    print()
