import math
import numpy as np
from vibrissa.numerics import compiled, cos, log

@compiled
def philox_normal(seed, stream, counter):
    m = np.uint64(0xFFFFFFFF)
    s = np.uint64(32)
    k0 = np.uint64(seed) & m
    k1 = np.uint64(seed) >> s
    c0 = np.uint64(counter) & m
    c1 = np.uint64(counter) >> s
    c2 = np.uint64(stream) & m
    c3 = np.uint64(stream) >> s
    for _ in range(10):
        p0 = np.uint64(0xD2511F53) * c0
        p1 = np.uint64(0xCD9E8D57) * c2
        c0, c1, c2, c3 = (p1 >> s) ^ c1 ^ k0, p1 & m, (p0 >> s) ^ c3 ^ k1, p0 & m
        k0 = (k0 + np.uint64(0x9E3779B9)) & m
        k1 = (k1 + np.uint64(0xBB67AE85)) & m
    a = (float((c0 << s | c1) >> np.uint64(11)) + 1.0) * 2.0**-53
    b = float((c2 << s | c3) >> np.uint64(11)) * 2.0**-53
    return math.sqrt(-2.0 * log(a)) * cos(6.283185307179586 * b)
