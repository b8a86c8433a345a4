// What is done to the value of a pixel, with the derivatives: the transfer function of sRGB and its inverse, and what a
// sensor records of light. The formulas are in pixel_ops.py and sensor/steps.py.
//
// y^2.4 = y y (u y) with u = y^(-3/5), and x^(5/12) = u x with u = x^(-7/12). Polynomials give u to some 1e-4. What its
// fifth (twelfth) power times y^3 (x^7) lacks of one, e, corrects it: (1 - e)^(-1/n) = 1 + e / n + (n + 1) e^2 / 2 n^2.
// The derivatives are made of the same u.
//
// Counts below 25 electrons are found term by term in double, as float32 would change one in 3e5. Above, the normal
// quantile is (2 u - 1) G(w) with w = -log(4 u (1 - u)), G a polynomial of w, or of its root beyond 5.
//
// Compiled by build.py with REAL as float or double; without fast-math: NaN stays NaN, and in sRGB goes the way of small
// numbers.

#include <float.h>
#include <math.h>

#include "vectors.h"

enum { CORRECTIONS = SINGLE ? 1 : 2, BLOCK = 4096, MOST_COUNTED = 80, WIDE = VECTOR_BYTES / sizeof(double) };

typedef double wide __attribute__((vector_size(VECTOR_BYTES)));
typedef REAL narrow __attribute__((vector_size(WIDE * sizeof(REAL)), may_alias));
typedef int64_t wide_bits __attribute__((vector_size(VECTOR_BYTES)));

// The fields of `_fill` in pixel_ops.py. All tensors but `x` and `out` may be null.
typedef struct {
    int64_t threads;
    const REAL *x, *gradient, *shot, *read, *offset;
    REAL *out;
    int64_t count;
    double full_well, dark, sigma;
    int64_t top, clip;  // top: of the converter's levels, 0 for none
} pixels;

static const REAL CENTRE[] = {2.12331348,     0.348802028,     -0.00590772566, -0.00177162265, 0.000308792663,
                              -7.03206336e-06, -4.89881495e-06, 6.62037701e-07, 3.30020413e-08, -1.26316508e-08};
static const REAL TAIL[] = {5.60594723, 1.42802381, 0.00136654142, -0.00101984785, 0.000365878197,
                            -0.000140019447, 5.05272798e-05, -6.6594985e-06, 1.26468975e-05, -1.74652517e-05,
                            4.91692618e-06, 1.39590506e-06, -5.92056351e-07};

// Keeps a product from being contracted with a sum, so that it is rounded as without a compiler.
INLINE vec rounded(vec x) {
    __asm__("" : "+m"(x));
    return x;
}

INLINE vec root(vec x) {
    REAL lanes[LANES];
    memcpy(lanes, &x, sizeof x);
    for (int i = 0; i < LANES; i++) lanes[i] = SINGLE ? sqrtf(lanes[i]) : sqrt(lanes[i]);
    memcpy(&x, lanes, sizeof x);
    return x;
}

INLINE int any(const void *condition) {
    int64_t words[VECTOR_BYTES / 8], found = 0;
    memcpy(words, condition, sizeof words);
    for (int i = 0; i < VECTOR_BYTES / 8; i++) found |= words[i];
    return found != 0;
}

INLINE vec bounded(vec x, vec lowest, vec highest) {
    x = choose(x < lowest, lowest, x);
    return choose(x > highest, highest, x);
}

// log(x) of positive normal numbers, by 2 artanh((m - 1) / (m + 1)) of the mantissa m, to 1e-8.
INLINE vec logarithm(vec x) {
    const bits half = bits_of(all((REAL)0.70710678));
    bits exponent = (bits_of(x) - half) >> FRACTION;
    vec mantissa = real_of(bits_of(x) - (exponent << FRACTION));
    vec z = (mantissa - 1) / (mantissa + 1), square = z * z;
    vec series = 1 + square * ((REAL)(1. / 3) + square * ((REAL)0.2 + square * ((REAL)(1. / 7) + square * (REAL)(1. / 9))));
    return (REAL)0.69314718056 * __builtin_convertvector(exponent, vec) + 2 * z * series;
}

// The normal quantile of u: Halley's method takes 1e-7 to the precision of double.
INLINE vec normal_quantile(vec u) {
    const REAL epsilon = SINGLE ? 0x1p-23 : 0x1p-52;
    u = bounded(u, all(epsilon / 4), all(1 - epsilon / 2));
    vec w = -logarithm(4 * u * (1 - u)), gain = polynomial(CENTRE, 9, w - (REAL)2.5);
    bits rare = w > 5;
    if (any(&rare)) gain = choose(rare, polynomial(TAIL, 12, root(w) - (REAL)4.12303399), gain);
    vec quantile = (2 * u - 1) * gain;
    if (SINGLE) return quantile;
    for (int i = 0; i < LANES; i++) {
        const double p = u[i] < 0.5 ? u[i] : 1 - u[i];
        double q = -fabs(quantile[i]);
        for (int n = 0; n < 2; n++) {
            const double off = (0.5 * erfc(-q * M_SQRT1_2) - p) * sqrt(2 * M_PI) * exp(0.5 * q * q);
            q -= off / (1 + 0.5 * q * off);
        }
        quantile[i] = u[i] < 0.5 ? q : -q;
    }
    return quantile;
}

// exp(-x) for x from 0 to 25 in double: the series of what is left below a power of two.
INLINE wide decayed(wide x) {
    const double unit = 0x1.8p52;
    wide power = x * -M_LOG2E + unit, rest = -x - (power - unit) * 0x1.62e42fefap-1 - (power - unit) * 0x1.cf79abc9e3b3ap-40;
    wide sum = 1 + rest * (1. / 13);
#pragma GCC unroll 12
    for (int n = 12; n >= 1; n--) sum = 1 + rest * (1. / n) * sum;
    wide_bits shift, result;
    memcpy(&shift, &power, sizeof shift), memcpy(&result, &sum, sizeof result);
    result += shift << 52;
    memcpy(&sum, &result, sizeof sum);
    return sum;
}

// Counts electrons below 25: the least k with P(X <= k) >= u, zero where the rate is zero.
INLINE vec counted(vec rate, vec u) {
    const double most = 1 - 32 * DBL_EPSILON;  // the sum of all terms is not exact to more
    vec counts;
    for (int part = 0; part < LANES / WIDE; part++) {
        narrow rates, uniforms, made;
        memcpy(&rates, (const narrow *)&rate + part, sizeof rates);
        memcpy(&uniforms, (const narrow *)&u + part, sizeof uniforms);
        wide mean = __builtin_convertvector(rates, wide), uniform = __builtin_convertvector(uniforms, wide);
        uniform += __builtin_convertvector(uniform > most, wide) * (uniform - most);
        wide term = decayed(mean), below = term, count = {0};
        for (int k = 1; k <= MOST_COUNTED; k += 4) {
            wide_bits more = uniform > below;
            if (!any(&more)) break;
            for (int own = k; own < k + 4; own++) {
                count -= __builtin_convertvector(uniform > below, wide);
                term *= mean * (1. / own);
                below += term;
            }
        }
        made = __builtin_convertvector(count, narrow);
        memcpy((narrow *)&counts + part, &made, sizeof made);
    }
    return counts;
}

// Records light x or, with `slope`, computes the derivative: of the n-th pixel, and so many more.
INLINE vec recorded(vec x, const pixels *s, int64_t n, int64_t count, int slope) {
    const REAL full_well = s->full_well, dark = s->dark, sigma = s->sigma, top = s->top;
    vec derivative = all(1);
    if (s->shot) {
        vec u = load_some(s->shot + n, count), zero = all(0), threshold = all(25), light = choose(x < 0, zero, x);
        vec rate = rounded(light * full_well) + dark, electrons = zero, slope_of = all(1);
        bits dim = rate < threshold, others = ~dim;
        if (any(&dim)) electrons = counted(choose(dim, rate, zero), u);
        if (any(&others)) {
            vec bright = choose(dim, threshold, rate), width = root(bright), quantile = normal_quantile(u);
            vec drawn = bright + width * quantile;
            electrons = choose(dim, electrons, choose(drawn < 0, zero, drawn));
            if (slope) slope_of = choose(dim, slope_of, choose(drawn >= 0, 1 + quantile / (2 * width), zero));
        }
        if (slope) derivative = choose(x >= 0, slope_of, zero);
        if (s->clip) {
            vec well = all(full_well);
            if (slope) derivative = choose(electrons <= well, derivative, zero);
            electrons = choose(electrons > well, well, electrons);
        }
        x = (electrons - dark) / full_well;
    }
    if (s->read) x += rounded(sigma * load_some(s->read + n, count));
    if (s->offset) x += load_some(s->offset + n, count);
    if (top > 0) {
        const vec whole = all(SINGLE ? 0x1p23 : 0x1p52);  // larger numbers are whole
        vec level = rounded(x * top), size = choose(level < 0, -level, level);
        vec nearest = rounded(size + whole) - whole;
        level = choose(size < whole, choose(level < 0, -nearest, nearest), level);
        x = level / top;
    }
    if (!s->clip) return slope ? derivative : x;
    if (slope) return choose((x >= 0) & (x <= 1), derivative, all(0));
    return bounded(x, all(0), all(1));
}

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
INLINE vec decoded(vec x, int slope) {
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
INLINE vec encoded(vec x, int slope) {
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

enum { DECODE, ENCODE, RECORD };

// Computes the values of `count` pixels, a vector at most, or with `slope` the products of their gradient and the derivative.
INLINE void compute_some(const pixels *p, int64_t n, int64_t count, int kind, int slope) {
    vec x = load_some(p->x + n, count);
    x = kind == RECORD ? recorded(x, p, n, count, slope) : kind == ENCODE ? encoded(x, slope) : decoded(x, slope);
    if (slope) x *= load_some(p->gradient + n, count);
    store_some(p->out + n, &x, count);
}

INLINE void compute_block(pixels p, int64_t n, int64_t end, int kind, int slope) {
    for (; n + LANES <= end; n += LANES) compute_some(&p, n, LANES, kind, slope);
    if (n < end) compute_some(&p, n, end - n, kind, slope);
}

INLINE void compute_from(const pixels *p, int64_t n, int kind) {
    const int64_t end = least(n + BLOCK, p->count);
    if (p->gradient) compute_block(*p, n, end, kind, 1);
    else compute_block(*p, n, end, kind, 0);
}

static int compute(const pixels *p, int kind) {
#pragma omp parallel for num_threads(p->threads) if (p->count > 8 * BLOCK)
    for (int64_t n = 0; n < p->count; n += BLOCK) {
        if (kind == DECODE) compute_from(p, n, DECODE);
        else if (kind == ENCODE) compute_from(p, n, ENCODE);
        else compute_from(p, n, RECORD);
    }
    return 0;
}

int decode(const pixels *p) { return compute(p, DECODE); }

int encode(const pixels *p) { return compute(p, ENCODE); }

int record(const pixels *p) { return compute(p, RECORD); }
