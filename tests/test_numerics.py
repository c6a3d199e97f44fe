import ast
import hashlib
import importlib.util
import itertools
import math
import os
import re
import shutil
import statistics
import subprocess
import sys
import types
from pathlib import Path

import llvmlite.binding
import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mpmath import mp, mpf
from numba.core.caching import IndexDataCacheFile
from scipy import stats

import vibrissa
from vibrissa import elementary
from vibrissa.compilation import CacheFile, imports, kept
from vibrissa.numerics import (
    MAX_ANGLE,
    acos,
    asin,
    atan2,
    compiled,
    cos,
    cos_sin_turn,
    exp,
    hypot,
    log,
    normal_quantile,
    philox4x32,
    philox_normal,
    philox_normals4,
    philox_uniform,
    sin,
)

mp.prec = 400
ROOT = Path(__file__).parent.parent
RNG = np.random.default_rng(20240611)
INF, NAN = math.inf, math.nan
TINY = 5e-324


@compiled
def all_sin(x, out):
    for i in range(x.shape[0]):
        out[i] = sin(x[i])


@compiled
def all_cos(x, out):
    for i in range(x.shape[0]):
        out[i] = cos(x[i])


@compiled
def all_exp(x, out):
    for i in range(x.shape[0]):
        out[i] = exp(x[i])


@compiled
def all_log(x, out):
    for i in range(x.shape[0]):
        out[i] = log(x[i])


@compiled
def all_asin(x, out):
    for i in range(x.shape[0]):
        out[i] = asin(x[i])


@compiled
def all_acos(x, out):
    for i in range(x.shape[0]):
        out[i] = acos(x[i])


@compiled
def all_atan2(y, x, out):
    for i in range(x.shape[0]):
        out[i] = atan2(y[i], x[i])


@compiled
def all_hypot(y, x, out):
    for i in range(x.shape[0]):
        out[i] = hypot(y[i], x[i])


LOOPS = {
    sin: all_sin,
    cos: all_cos,
    exp: all_exp,
    log: all_log,
    asin: all_asin,
    acos: all_acos,
    atan2: all_atan2,
    hypot: all_hypot,
}


def neighbours(values, steps=2):
    """The values with the doubles next to them on both sides."""
    around = [np.asarray(values, dtype=np.float64)]
    for direction in (-INF, INF):
        x = around[0]
        for _ in range(steps):
            x = np.nextafter(x, direction)
            around.append(x)
    return np.concatenate(around)


def near_multiples_of_half_pi():
    """The doubles m 2^q < 2^27 that come closest to a multiple of pi/2: continued fractions."""
    found = []
    for q in range(-53, -25):
        value = mpf(2) ** q * 2 / mp.pi
        before, now = 1, 0
        for _ in range(60):
            whole = int(mp.floor(value))
            before, now = now, whole * now + before
            if now >= 2**53:
                break
            found += [m * now * 2.0**q for m in (1, 2, 3, 5) if 2**52 <= m * now < 2**53]
            value = 1 / (value - whole)
    return np.array(found)


ANGLES = np.concatenate(
    [
        RNG.uniform(-8, 8, 3000),
        RNG.uniform(-1e5, 1e5, 2000),
        RNG.uniform(-MAX_ANGLE, MAX_ANGLE, 1000),
        10.0 ** RNG.uniform(-20, 0, 500),
        neighbours(np.arange(-400, 400) * (math.pi / 4)),
        near_multiples_of_half_pi(),
        [MAX_ANGLE, -MAX_ANGLE, TINY, 2.0**-1022, 1e-300],
    ]
)
POWERS = np.concatenate(
    [
        RNG.uniform(-1, 1, 3000),
        RNG.uniform(-745, 709.7, 3000),
        neighbours((np.arange(-2148, 2047) + 1) * (math.log(2) / 2), 1),
        neighbours([709.782712893384, -745.1332191019411, -708.3964185322641], 3),
        10.0 ** RNG.uniform(-20, 0, 300),
    ]
)
POSITIVE = np.concatenate(
    [
        RNG.uniform(0.5, 2, 4000),
        np.exp(RNG.uniform(-744, 709, 2000)),
        neighbours(2.0 ** np.arange(-1074, 1024), 1),
        neighbours(math.sqrt(0.5) * 2.0 ** np.arange(-20, 20)),
        1 + 2.0 ** RNG.uniform(-52, -1, 500) * RNG.choice([-1, 1], 500),
        RNG.integers(1, 2**52, 300) * TINY,
    ]
)
POSITIVE = POSITIVE[POSITIVE > 0]
SINES = np.concatenate(
    [
        RNG.uniform(-1, 1, 3000),
        (1 - 2.0 ** RNG.uniform(-53, 0, 1000)) * RNG.choice([-1, 1], 1000),
        2.0 ** RNG.uniform(-1074, 0, 500),
        neighbours(np.sin(np.arange(-6, 7) * math.pi / 8) * (1 - 2.0**-50)),
        [1.0, -1.0, 0.0, 0.5, -0.5],
    ]
)
_MIXED = 2.0 ** RNG.uniform(-1060, 1020, (2, 1500)) * RNG.choice([-1, 1], (2, 1500))
_EQUAL = RNG.uniform(-1, 1, 500)
_SLOPES = _EQUAL * (math.tan(math.pi / 8) * (1 + RNG.uniform(-1e-15, 1e-15, 500)))
_ORDINATES = np.concatenate(
    [
        RNG.normal(size=3000),
        _MIXED[0],
        _EQUAL,
        np.nextafter(_EQUAL, 2),
        _SLOPES,
        [TINY, 1e308, TINY],
    ]
)
_ABSCISSAS = np.concatenate(
    [RNG.normal(size=3000), _MIXED[1], _EQUAL, -_EQUAL, _EQUAL, [1e308, TINY, -TINY]]
)
POINTS = (_ORDINATES, _ABSCISSAS)

CASES = [
    (sin, mp.sin, (ANGLES,)),
    (cos, mp.cos, (ANGLES,)),
    (exp, mp.exp, (POWERS,)),
    (log, mp.log, (POSITIVE,)),
    (asin, mp.asin, (SINES,)),
    (acos, mp.acos, (SINES,)),
    (atan2, mp.atan2, POINTS),
    (hypot, mp.hypot, POINTS),
]
each_function = pytest.mark.parametrize(
    "function, exact, arguments", CASES, ids=lambda v: getattr(v, "__name__", "")
)


def looped(function, arguments):
    out = np.empty(arguments[0].shape[0])
    LOOPS[function](*(np.ascontiguousarray(a, dtype=np.float64) for a in arguments), out)
    return out


def ulps(found, exact):
    """Distance in units in the last place of the double next to `exact`."""
    nearest = abs(float(exact))
    if math.isinf(found) or math.isinf(nearest):
        return 0.0 if found == float(exact) else INF
    return float(abs(mpf(found) - exact) / mpf(float(np.spacing(nearest))))


@each_function
def test_results_are_at_most_one_ulp_off(function, exact, arguments):
    found = looped(function, arguments)
    errors = [
        ulps(float(value), exact(*(mpf(float(x)) for x in xs)))
        for value, *xs in zip(found, *arguments, strict=True)
    ]
    worst = int(np.argmax(errors))
    assert errors[worst] <= 1.0, [a[worst] for a in arguments]
    assert errors[worst] > 0.4  # rounding alone costs half: the measure is not blind


@each_function
def test_a_vectorised_loop_gives_the_bits_of_single_calls(function, exact, arguments):
    whole = looped(function, arguments)
    for start, stop in ((0, 257), (1, 4), (3, 20)):
        part = looped(function, [a[start:stop] for a in arguments])
        assert part.tobytes() == whole[start:stop].tobytes()
    single = [function(*map(float, xs)) for xs in zip(*(a[:300] for a in arguments), strict=True)]
    assert np.array(single).tobytes() == whole[:300].tobytes()


EDGES = [
    (sin, (0.0,), 0.0),
    (sin, (-0.0,), -0.0),
    (sin, (TINY,), TINY),
    (sin, (np.nextafter(MAX_ANGLE, INF),), NAN),
    (sin, (-INF,), NAN),
    (sin, (NAN,), NAN),
    (cos, (-0.0,), 1.0),
    (cos, (1e300,), NAN),
    (cos, (INF,), NAN),
    (cos, (-NAN,), NAN),
    (exp, (0.0,), 1.0),
    (exp, (-0.0,), 1.0),
    (exp, (709.782712893384,), float(mp.exp(mpf(709.782712893384)))),
    (exp, (709.7827128933841,), INF),
    (exp, (INF,), INF),
    (exp, (1e308,), INF),
    (exp, (-745.1332191019411,), TINY),
    (exp, (-745.1332191019412,), 0.0),
    (exp, (-1e308,), 0.0),
    (exp, (-INF,), 0.0),
    (exp, (-NAN,), NAN),
    (log, (1.0,), 0.0),
    (log, (0.0,), -INF),
    (log, (-0.0,), -INF),
    (log, (TINY,), -744.4400719213812),
    (log, (1.7976931348623157e308,), 709.782712893384),
    (log, (INF,), INF),
    (log, (-TINY,), NAN),
    (log, (-INF,), NAN),
    (log, (NAN,), NAN),
    (asin, (-0.0,), -0.0),
    (asin, (1.0,), math.pi / 2),
    (asin, (np.nextafter(1, 2),), NAN),
    (acos, (1.0,), 0.0),
    (acos, (-1.0,), math.pi),
    (acos, (-1.5,), NAN),
    (hypot, (3.0, 4.0), 5.0),
    (hypot, (0.0, -0.0), 0.0),
    (hypot, (1e308, 1e308), 1.4142135623730951e308),
    (hypot, (1.7e308, 1.7e308), INF),
    (hypot, (NAN, -INF), INF),
    (hypot, (NAN, 1.0), NAN),
    (atan2, (NAN, 1.0), NAN),
    (atan2, (1.0, -NAN), NAN),
    *(
        (atan2, (y, x), math.atan2(y, x))
        for y, x in itertools.product((0.0, -0.0, 1.0, -1.0, INF, -INF), repeat=2)
    ),
]


@pytest.mark.parametrize("function, arguments, expected", EDGES)
def test_edges_of_the_domain(function, arguments, expected):
    # Bytes tell -0.0 from 0.0, and also hold NaN to a single pattern.
    expected = np.float64(expected).tobytes()
    assert np.float64(function(*map(float, arguments))).tobytes() == expected
    vectorised = looped(function, [np.full(9, a) for a in arguments])
    assert vectorised.tobytes() == 9 * expected


finite = st.floats(allow_nan=False, allow_infinity=False)


@given(finite, finite)
def test_symmetries_are_exact(x, y):
    def same(a, b):
        return a == b or (math.isnan(a) and math.isnan(b))

    assert same(sin(-x), -sin(x)) and same(cos(-x), cos(x))
    assert atan2(-y, x) == -atan2(y, x)
    assert hypot(x, y) == hypot(-y, x)
    assert abs(sin(x)) <= 1.0 or math.isnan(sin(x))
    assert abs(atan2(y, x)) <= math.pi


@pytest.mark.parametrize(
    "function, low, high", [(exp, -700, 700), (log, 1e-9, 50), (sin, -1.5, 1.5), (asin, -1, 1)]
)
def test_growing_functions_never_step_back(function, low, high):
    starts = RNG.uniform(low, high, 3000)
    values = [looped(function, (x,)) for x in (starts, np.nextafter(starts, INF))]
    assert np.all(values[1] >= values[0])


def test_coefficients_are_as_good_as_their_derivation_says():
    path = ROOT / "docs" / "derivations" / "elementary_functions.py"
    spec = importlib.util.spec_from_file_location("derivation", path)
    derivation = importlib.util.module_from_spec(spec)
    precision = mp.prec
    spec.loader.exec_module(derivation)
    try:
        for p in derivation.POLYNOMIALS:
            used = list(getattr(elementary, f"_{p.name}"))
            assert len(used) == p.terms
            limit = mpf(2) ** -53 * 0.04
            assert derivation.largest_error(p, used, 100) < limit
            used[p.terms // 2] *= 1.001
            assert derivation.largest_error(p, used, 100) > limit
        for name, (value, bits) in derivation.SPLITS.items():
            assert list(getattr(elementary, f"_{name}")) == derivation.split(value, bits)
    finally:
        mp.prec = precision


def assembler(loop):
    return "\n".join(loop.inspect_asm().values())


HAS_FMA = llvmlite.binding.get_host_cpu_features().get("fma", False)
FUSED = re.compile(r"\bvfn?m(?:add|sub)\w*")


@pytest.mark.skipif(not HAS_FMA, reason="this CPU has no FMA")
def test_compiled_code_contains_no_fused_multiply_add():
    for function, _, arguments in CASES:
        looped(function, arguments)
        assert not FUSED.findall(assembler(LOOPS[function]))

    @numba.njit(fastmath=True)
    def fusing(a, b, out):
        for i in range(a.shape[0]):
            out[i] = a[i] * b[i] + out[i]

    fusing(np.ones(3), np.ones(3), np.ones(3))
    assert FUSED.findall(assembler(fusing))


BYTES = """
import hashlib, math, numba, numpy as np, sys
from vibrissa.numerics import *
def loop(function, n):
    if n == 1:
        def run(a, b, out):
            for i in range(out.shape[0]):
                out[i] = function(a[i])
    else:
        def run(a, b, out):
            for i in range(out.shape[0]):
                out[i] = function(a[i], b[i])
    return numba.njit(error_model="numpy")(run)
u = np.array([philox_uniform(1, 2, i) for i in range(4000)])
v = np.array([philox_normal(1, 3, i) for i in range(4000)])
own, libm = [], []
for function, peer, a in ((sin, math.sin, 1e3 * v), (cos, math.cos, 1e3 * v),
                          (exp, math.exp, 50 * v), (log, math.log, 5 * u)):
    for f, results in ((function, own), (peer, libm)):
        results.append(np.empty(4000))
        loop(f, 1)(a, a, results[-1])
for f, a in ((atan2, v), (hypot, v), (acos, 2 * u - 1)):
    own.append(np.empty(4000))
    loop(f, 1 if f is acos else 2)(a, u, own[-1])
own += [u, v, np.array([philox_normals4(-7, 9, i) for i in range(3000)])]
for results in (own, libm):
    print(hashlib.sha256(b"".join(r.tobytes() for r in results)).hexdigest())
one = own[0]
one[17] = np.nextafter(one[17], 2)
print(hashlib.sha256(b"".join(r.tobytes() for r in own)).hexdigest())
"""


@compiled
def turns(u, c, s):
    for i in range(u.shape[0]):
        c[i], s[i] = cos_sin_turn(u[i])


def test_cosine_and_sine_of_turns_are_within_two_units_in_the_last_place():
    words = np.random.default_rng(3).integers(0, 2**32, 4000)
    u = np.concatenate([(words + 0.5) * 2.0**-32, np.arange(-16, 17) / 8, [1e-9, 1234.56789]])
    c, s = np.empty_like(u), np.empty_like(u)
    turns(u, c, s)
    with mp.workdps(60):
        for k in range(len(u)):
            for found, exact in (
                (c[k], mp.cos(2 * mp.pi * mpf(u[k]))),
                (s[k], mp.sin(2 * mp.pi * mpf(u[k]))),
            ):
                # The nearest double to a zero of either is zero.
                assert abs(mpf(float(found)) - exact) <= 2 * math.ulp(float(exact)) + mpf(10) ** -50
    one_by_one = [cos_sin_turn(value) for value in u.tolist()]
    assert np.array(one_by_one).tobytes() == np.stack([c, s], axis=1).tobytes()


def test_bits_do_not_depend_on_the_cpu_or_the_c_library(tmp_path):
    settings = [
        {},
        {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-AVX2_Usable,-FMA,-FMA_Usable,-FMA4"},
        {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": "", "NUMBA_CACHE_DIR": str(tmp_path)},
    ]
    runs = [
        subprocess.Popen(
            [sys.executable, "-c", BYTES],
            env={**os.environ, **setting},
            stdout=subprocess.PIPE,
            text=True,
        )
        for setting in settings
    ]
    found = [run.communicate()[0].split() for run in runs]
    assert all(run.returncode == 0 for run in runs)
    assert len({own for own, _, _ in found}) == 1
    # The comparison tells a single last bit, and the C library's functions with and without FMA.
    own, libm, flipped = found[0]
    assert own not in (libm, flipped)
    assert libm != found[1][1] or not HAS_FMA


def test_compiled_code_on_disk_follows_the_sources_it_was_made_from(tmp_path):
    package = tmp_path / "vibrissa"
    package.mkdir()
    (package / "__init__.py").write_text("")
    shutil.copy(Path(vibrissa.__file__).parent / "compilation.py", package)
    (package / "deep.py").write_text("CONSTANT = 1.0\n")
    (package / "inner.py").write_text(
        "from vibrissa.compilation import inlined\nfrom vibrissa.deep import CONSTANT\n"
        "@inlined\ndef f():\n    return CONSTANT\n"
    )
    (package / "outer.py").write_text(
        "import numba\nfrom vibrissa import inner\nfrom vibrissa.compilation import compiled\n"
        "f = inner.f\ndef g():\n    return f()\n"
        "ours, plain = compiled(g), numba.njit(cache=True)(lambda: f())\n"
    )
    script = (
        "from vibrissa import outer\nprint(outer.ours(), outer.plain(),"
        "sum(outer.ours.stats.cache_hits.values()))"
    )

    def run():
        environment = {**os.environ, "PYTHONPATH": str(tmp_path), "PYTHONDONTWRITEBYTECODE": "1"}
        environment["NUMBA_CACHE_DIR"] = str(tmp_path / "cache")
        command = [sys.executable, "-c", script]
        done = subprocess.run(
            command, env=environment, cwd=tmp_path, capture_output=True, text=True, check=True
        )
        return done.stdout.split()

    assert run() == ["1.0", "1.0", "0"]
    assert run() == ["1.0", "1.0", "1"]
    (package / "deep.py").write_text("CONSTANT = 2.0\n")
    assert run() == ["2.0", "1.0", "0"]  # numba alone goes on with what it has


def test_processes_that_compile_at_once_never_load_each_others_code(tmp_path):
    old, new, late = (CacheFile(str(tmp_path), "kernel", stamp) for stamp in ("old", "new", "new"))
    old.save(("f32",), "old code")
    assert old.load(("f32",)) == "old code"
    assert new.load(("f32",)) is None
    # a second process looks into the index before the first has written to it, and writes after it
    seen = late._load_index()
    late._load_index = lambda: seen
    new.save(("f32",), "code for f32")
    late.save(("f64",), "code for f64")
    del late._load_index
    for key in (("f32",), ("f64",)):
        assert new.load(key) in (f"code for {key[0]}", None)
    assert late.load(("f64",)) == "code for f64"


def test_an_index_never_points_to_code_that_is_not_written_yet(tmp_path, monkeypatch):
    CacheFile(str(tmp_path), "kernel", "old").save(("f32",), "old code")
    file = CacheFile(str(tmp_path), "kernel", "new")
    seen = []

    def look(name, data):
        seen.append(CacheFile(str(tmp_path), "kernel", "new").load(("f32",)))
        IndexDataCacheFile._save_data(file, name, data)
        seen.append(CacheFile(str(tmp_path), "kernel", "new").load(("f32",)))

    monkeypatch.setattr(file, "_save_data", look)
    file.save(("f32",), "new code")
    assert seen == [None, None] and file.load(("f32",)) == "new code"


@pytest.mark.parametrize(
    "counter, key, words",
    [
        ((0, 0, 0, 0), (0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
        ((-1, -1, -1, -1), (-1, -1), (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
        (
            (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
            (0xA4093822, 0x299F31D0),
            (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
        ),
    ],
)
def test_philox_gives_the_known_answers_of_random123(counter, key, words):
    assert philox4x32(*counter, *key) == words


@given(*[st.integers(-(2**63), 2**63 - 1)] * 3)
def test_a_draw_takes_its_block_from_all_bits_of_its_arguments(seed, stream, counter):
    halves = [half for value in (counter, stream, seed) for half in (value, value >> 32)]
    words = philox4x32(*(half & 0xFFFFFFFF for half in halves))
    uniform = philox_uniform(seed, stream, counter)
    assert uniform == ((words[0] * 2**20 + words[1] // 2**12) * 2 + 1) / 2**53
    assert 0.0 < uniform < 1.0
    assert philox_normal(seed, stream, counter) == normal_quantile(uniform)
    expected = tuple(normal_quantile((2 * word + 1) / 2**33) for word in words)
    assert philox_normals4(seed, stream, counter) == expected


@compiled
def draws(seed, stream, n):
    uniform = np.empty(n)
    normal = np.empty(n)
    four = np.empty((n, 4))
    for i in range(n):
        uniform[i] = philox_uniform(seed, stream, i)
        normal[i] = philox_normal(seed, stream, i)
        four[i, 0], four[i, 1], four[i, 2], four[i, 3] = philox_normals4(seed, stream, i)
    return uniform, normal, four


def test_draws_have_the_moments_and_distribution_they_should():
    n = 200_000
    uniform, normal, four = draws(11, 3, n)
    assert stats.kstest(uniform, "uniform").pvalue > 1e-3
    for sample in (normal, *four.T):
        assert stats.kstest(sample, "norm").pvalue > 1e-3
        for power, moment, deviation in ((1, 0, 1), (2, 1, 2), (3, 0, 15), (4, 3, 96)):
            assert abs(np.mean(sample**power) - moment) < 4.5 * math.sqrt(deviation / n)


def test_draws_are_independent_across_counter_stream_seed_and_place():
    n = 200_000
    _, a, four = draws(11, 3, n)
    pairs = [(a[1:], a[:-1]), (a[64:], a[:-64])]
    pairs += [(a, draws(11, 4, n)[1]), (a, draws(12, 3, n)[1])]
    pairs += list(itertools.combinations(four.T, 2))
    for left, right in pairs:
        for transform in (lambda x: x, np.square, np.abs):
            correlation = np.corrcoef(transform(left), transform(right))[0, 1]
            assert abs(correlation) < 4.5 / math.sqrt(n)


def test_the_normal_quantile_is_exact_to_sixteen_digits():
    seams = neighbours([0.075, 0.925, math.exp(-25)], 20)
    u = np.concatenate([RNG.uniform(size=2000), 2.0 ** RNG.uniform(-53, -1, 1000), seams])
    expected = np.array([statistics.NormalDist().inv_cdf(p) for p in u])
    found = np.array([normal_quantile(p) for p in u])
    assert np.max(np.abs(found - expected) / np.abs(expected)) < 1e-15
    for p in (2.0**-53, 1e-12, 1e-3, 0.07, 0.2, 0.7):
        exact = mp.findroot(lambda z: mp.ncdf(z) - mpf(p), float(normal_quantile(p)))  # noqa: B023
        assert abs(normal_quantile(p) / exact - 1) < 1e-15


def test_bits_are_those_of_every_other_machine():
    uniform, normal, four = draws(-5, 2**40, 1000)
    parts = [uniform, normal, four]
    parts += [looped(f, (50 * normal,)) for f in (sin, cos, exp)]
    parts += [looped(f, (uniform,)) for f in (log, asin, acos)]
    parts += [looped(f, (normal, uniform)) for f in (atan2, hypot)]
    digest = hashlib.sha256(b"".join(part.tobytes() for part in parts))
    assert digest.hexdigest() == (
        "7dee29167b755f01f23de0bb6643657f7ca6fd1170848be0a0d9882aad1ea1f5"
    )


def test_every_import_of_the_package_is_found_in_its_sources():
    def parsed(source):
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.Import):
                yield from (alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.module:
                yield node.module
                yield from (f"{node.module}.{alias.name}" for alias in node.names)

    folder = Path(vibrissa.__file__).parent
    sources = [
        file.read_text() for part in ("", "*/", "*/*/") for file in folder.glob(f"{part}*.py")
    ]
    assert len(sources) > 150
    for source in sources:
        own = {name for name in parsed(source) if name.partition(".")[0] == "vibrissa"}
        assert own <= imports(source)


def test_a_table_on_disk_is_used_unless_it_is_damaged(tmp_path):
    made = []

    def make():
        made.append(np.arange(6.0).reshape(2, 3))
        return made[-1]

    kernel = types.SimpleNamespace(py_func=make, _cache=types.SimpleNamespace(cache_path=tmp_path))
    for case, times in ((0.3, 1), (0.3, 1), (0.5, 2)):
        table = kept(kernel, case, (2, 3), make)
        assert table.tobytes() == made[0].tobytes() and not table.flags.writeable
        assert len(made) == times
    (first, _) = sorted(tmp_path.iterdir())
    whole = first.read_bytes()
    for damaged in (b"", whole[:-1], whole[:40] + bytes([whole[40] ^ 1]) + whole[41:]):
        first.write_bytes(damaged)
        kept(kernel, 0.3, (2, 3), make)
        kept(kernel, 0.5, (2, 3), make)
        assert first.read_bytes() == whole
    assert len(made) == 5
    nowhere = types.SimpleNamespace(py_func=make)
    assert kept(nowhere, 0.3, (2, 3), make) is made[-1]
