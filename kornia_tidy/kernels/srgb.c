// The transfer function of sRGB and its inverse, with their derivatives. The formulas are in srgb_ops.py.
//
// y^2.4 = y y (u y) with u = y^(-3/5), and x^(5/12) = u x with u = x^(-7/12). Polynomials give u to some 1e-4. What its
// fifth (twelfth) power times y^3 (x^7) lacks of one, e, corrects it: (1 - e)^(-1/n) = 1 + e / n + (n + 1) e^2 / 2 n^2.
// The derivatives are made of the same u.
//
// Compiled by build.py with REAL as float or double; without fast-math, as NaN goes the way of small numbers.

#include <float.h>

#include "vectors.h"

enum { CORRECTIONS = SINGLE ? 1 : 2, BLOCK = 4096 };

// log2(1.5 + x) and exp2(x) for |x| <= 1/2, through Chebyshev's points.
static const REAL LOG2[] = {0.5849625, 0.96097399, -0.32013948, 0.15538812, -0.07844068};
static const REAL EXP2[] = {0.99992456, 0.69313673, 0.24263948, 0.05583828};

// Computes a power of positive normal numbers to 2e-4 of it.
INLINE vec rough_power(vec x, REAL power) {
    const vec unit = all(SINGLE ? 0x1p23 : 0x1p52), one = all(1);  // the last bit of `unit` is worth one
    vec exponent = real_of(bits_of(x) >> FRACTION | bits_of(unit)) - (unit + BIAS);
    vec mantissa = real_of((bits_of(x) & (((lane)1 << FRACTION) - 1)) | bits_of(one));
    vec log = power * (exponent + polynomial(LOG2, 4, mantissa - (REAL)1.5));
    vec rounded = log + (REAL)1.5 * unit, rest = log - (rounded - (REAL)1.5 * unit);
    return real_of((bits_of(rounded) << FRACTION) + bits_of(polynomial(EXP2, 3, rest)));
}

// Computes the decoding of sRGB or, with `slope`, its derivative.
INLINE vec decode(vec x, int slope) {
    const double scale = 1 / 1.055;
    const REAL high = scale, low = scale - high, linear = 12.92, joint = 0.04045;
    const vec most = all(SINGLE ? 0x1p100 : 0x1p850);  // what is below overflows for more, and no sooner
    vec bounded = choose(x < most, x, most), y = bounded * high + (bounded * low + (REAL)(0.055 * scale));
    vec u = rough_power(y, -0.6), root;
    for (int n = 0; n < CORRECTIONS; n++) {
        root = u * y;
        vec lack = 1 - root * root * root * (u * u), correction = lack * ((REAL)0.2 + (REAL)0.12 * lack);
        u += u * correction, root += root * correction;
    }
    if (slope) return choose(x > joint, (REAL)(2.4 * scale) * y * root, all(1 / linear));
    return choose(x > joint, y * y * root, x / linear);
}

// Computes the encoding of sRGB or, with `slope`, its derivative.
INLINE vec encode(vec x, int slope) {
    const REAL high = 1.055, low = 1.055 - high, linear = 12.92, joint = 0.0031308;
    const vec most = all(SINGLE ? FLT_MAX : DBL_MAX);
    vec bounded = choose(x < most, x, most), u = rough_power(bounded, (REAL)(-7. / 12)), root, correction;
    for (int n = 0; n < CORRECTIONS; n++) {
        root = u * bounded;
        vec sixth = u * root, half = sixth * sixth * sixth, lack = 1 - half * bounded * half;
        correction = lack * ((REAL)(1. / 12) + (REAL)(13. / 288) * lack);
        u += u * correction;
    }
    if (slope) return choose(x > joint, (REAL)(1.055 * 5 / 12) * u, all(linear));
    vec rest = root * (low + high * correction) - (REAL)0.055 + (x - bounded);  // the last: infinity stays
    return choose(x > joint, root * high + rest, linear * x);
}

INLINE vec curve(vec x, int encoding, int slope) { return encoding ? encode(x, slope) : decode(x, slope); }

INLINE void convert_block(const REAL *x, const REAL *gradient, REAL *out, int64_t count, int encoding) {
    int64_t n = 0;
    for (; n + LANES <= count; n += LANES) {
        vec made = curve(*(const loose *)(x + n), encoding, gradient != 0);
        *(loose *)(out + n) = gradient ? made * *(const loose *)(gradient + n) : made;
    }
    vec last = {0};
    if (n == count) return;
    memcpy(&last, x + n, (count - n) * sizeof(REAL));
    last = curve(last, encoding, gradient != 0);
    for (int64_t i = 0; n + i < count; i++) out[n + i] = gradient ? last[i] * gradient[n + i] : last[i];
}

// Decodes or encodes `count` numbers; with a gradient, which may be null, multiplies it by the derivative instead.
void convert(const REAL *x, const REAL *gradient, REAL *out, int64_t count, int64_t encoding, int64_t threads) {
#pragma omp parallel for num_threads(threads) if (count > 8 * BLOCK)
    for (int64_t n = 0; n < count; n += BLOCK) {
        const int64_t size = least(BLOCK, count - n);
        if (gradient && encoding) convert_block(x + n, gradient + n, out + n, size, 1);
        else if (gradient) convert_block(x + n, gradient + n, out + n, size, 0);
        else if (encoding) convert_block(x + n, 0, out + n, size, 1);
        else convert_block(x + n, 0, out + n, size, 0);
    }
}
