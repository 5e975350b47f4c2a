/* What `_caught` and `_told` of shadow_time.py do, a few hundred pixels after the other. */

#include "_arrays.h"
#include <math.h>

/* So many pixels are worked on together, each step in a loop of its own, which lets the compiler
 * take several at a time. */
#define TOGETHER 512
/* Parts of the contrast by which values are counted, up to half of it. */
#define BINS 50

/* What comes in, (P,) each; the roughness of both ends may be missing. */
enum { AT, BEFORE, AFTER, LOWEST, HIGHEST, DARK_ROUGH, LIT_ROUGH, CROSSING };

/* Variance of the noise is slope times light and floor; its extremes lie so many standard
 * deviations beyond what was lit and dark. */
typedef struct {
    float slope, floor, beyond;
} noise_t;

/* As of `_extremes`: the light that was lit and dark, its difference, and the standard deviations
 * of both in its unit. */
typedef struct {
    float lit[TOGETHER], dark[TOGETHER], contrast[TOGETHER];
    float lit_sigma[TOGETHER], dark_sigma[TOGETHER];
} extremes_t;

static void sigmas(const float *gray, const float *rough, const noise_t *noise, float *sigma,
                   Py_ssize_t count)
{
    for (Py_ssize_t at = 0; at < count; at++)
        sigma[at] = sqrtf((gray[at] > 0 ? gray[at] : 0) * noise->slope + noise->floor);
    if (rough)
        for (Py_ssize_t at = 0; at < count; at++)
            sigma[at] = sqrtf(sigma[at] * sigma[at] + rough[at] * rough[at]);
}

static void find_extremes(void *const *parts, Py_ssize_t start, Py_ssize_t count,
                          const noise_t *noise, extremes_t *found)
{
    const float *lowest = (const float *)parts[LOWEST] + start;
    const float *highest = (const float *)parts[HIGHEST] + start;
    const float *dark_rough = parts[DARK_ROUGH], *lit_rough = parts[LIT_ROUGH];
    sigmas(highest, lit_rough ? lit_rough + start : NULL, noise, found->lit_sigma, count);
    sigmas(lowest, dark_rough ? dark_rough + start : NULL, noise, found->dark_sigma, count);
    for (Py_ssize_t at = 0; at < count; at++) {
        float lit = highest[at] - noise->beyond * found->lit_sigma[at];
        float dark = lowest[at] + noise->beyond * found->dark_sigma[at];
        float contrast = lit - dark;
        /* NaN stays. */
        contrast = contrast <= 1e-6f ? 1e-6f : contrast;
        found->lit[at] = lit;
        found->dark[at] = dark;
        found->contrast[at] = contrast;
        found->lit_sigma[at] /= contrast;
        found->dark_sigma[at] /= contrast;
    }
}

/* What part of the contrast is missing at one end, or 0 where that may be noise; and how often each
 * part occurs. */
static void catch_one(const float *from, const float *to, const float *contrast, const float *sigma,
                      const int32_t *crossed, float enough, float *part, int64_t *counts,
                      Py_ssize_t count)
{
    float seen[TOGETHER];
    for (Py_ssize_t at = 0; at < count; at++) {
        float own = (from[at] - to[at]) / contrast[at];
        /* NaN is nothing. */
        own = own > 0 ? own : 0;
        seen[at] = own < 1 ? own : 1;
    }
    for (Py_ssize_t at = 0; at < count; at++)
        part[at] = (crossed[at] > 0) & (seen[at] > enough * sigma[at]) ? seen[at] : 0;
    for (Py_ssize_t at = 0; at < count; at++)
        if (crossed[at] > 0 && seen[at] < 0.5f)
            counts[(int)((double)seen[at] * (2 * BINS))]++;
}

/* What is caught of pixels at one end. */
typedef struct {
    float *lost, *left, *fall;
    int64_t *counts;
} caught_t;

static void catch(void *const *parts, Py_ssize_t start, Py_ssize_t count,
                  const noise_t *noise, float enough, float chosen, const caught_t *caught)
{
    extremes_t ends;
    const int32_t *crossed = (const int32_t *)parts[AT] + start;
    const float *before = (const float *)parts[BEFORE] + start;
    const float *after = (const float *)parts[AFTER] + start;
    float *fall = caught->fall + start;
    find_extremes(parts, start, count, noise, &ends);
    catch_one(ends.lit, before, ends.contrast, ends.lit_sigma, crossed, enough,
              caught->lost + start, caught->counts, count);
    catch_one(after, ends.dark, ends.contrast, ends.dark_sigma, crossed, enough,
              caught->left + start, caught->counts + BINS, count);
    for (Py_ssize_t at = 0; at < count; at++) {
        float between = (before[at] - after[at]) / ends.contrast[at];
        fall[at] = between > 0 ? between : 0;
    }
    for (Py_ssize_t at = 0; at < count; at++) {
        float noise_alone = chosen * (ends.lit_sigma[at] + ends.dark_sigma[at]);
        float between = fall[at] * fall[at] - noise_alone * noise_alone;
        fall[at] = sqrtf(between > 0 ? between : 0);
    }
    for (Py_ssize_t at = 0; at < count; at++) {
        float own = fall[at];
        fall[at] = crossed[at] > 0 ? own : 0;
    }
}

/* Variance of an edge's profile; the least error, and that of interpolation; the error of an
 * interval between frames; the duration from which on interpolation takes over, and how much later
 * it has. */
typedef struct {
    float profile, least, least_between, interval, sharp, soft;
} edge_t;

static inline float within(float value, float least, float most)
{
    value = value < least ? least : value;
    return value > most ? most : value;
}

/* Take the time that one end tells where that was caught on its way and the other was not. */
static void take(const float *part, const float *other, const float *told, const float *sigma,
                 const float *sharp, const edge_t *edge, float *time, float *error,
                 Py_ssize_t count)
{
    float spread[TOGETHER];
    for (Py_ssize_t at = 0; at < count; at++)
        spread[at] = sharp[at] * sqrtf(sigma[at] * sigma[at] + edge->profile) + edge->least;
    for (Py_ssize_t at = 0; at < count; at++) {
        int alone = (part[at] > 0) & !(other[at] > 0);
        float by_this = told[at], of_this = spread[at], by_others = time[at], of_others = error[at];
        time[at] = alone ? by_this : by_others;
        error[at] = alone ? of_this : of_others;
    }
}

static void tell(void *const *parts, Py_ssize_t start, Py_ssize_t count,
                 const noise_t *noise, const edge_t *edge, const float *lost, const float *left,
                 const float *duration, float *time, float *error)
{
    extremes_t ends;
    float straight[TOGETHER];
    float sharp[TOGETHER] = {0}, by_lost[TOGETHER] = {0}, by_left[TOGETHER] = {0};
    const int32_t *crossed = (const int32_t *)parts[AT] + start;
    const float *before = (const float *)parts[BEFORE] + start;
    const float *after = (const float *)parts[AFTER] + start;
    find_extremes(parts, start, count, noise, &ends);
    for (Py_ssize_t at = 0; at < count; at++) {
        float threshold = (ends.lit[at] + ends.dark[at]) / 2;
        float part = (before[at] - threshold) / (before[at] - after[at]);
        straight[at] = (float)crossed[at] - 1 + within(part, 0, 1);
    }
    for (Py_ssize_t at = 0; at < count; at++)
        sharp[at] = duration[at] < 1 ? duration[at] : 1;
    for (Py_ssize_t at = 0; at < count; at++) {
        float late = (float)crossed[at], rest = 1 - sharp[at];
        by_lost[at] = late - 1 + (0.5f - lost[at]) * sharp[at];
        by_left[at] = late - (0.5f - left[at]) * sharp[at];
        /* Midway between the frames, unless one of them caught it. */
        time[at] = late - 0.5f;
        error[at] = (rest > 0.1f ? rest : 0.1f) * edge->interval;
    }
    take(lost, left, by_lost, ends.lit_sigma, sharp, edge, time, error, count);
    take(left, lost, by_left, ends.dark_sigma, sharp, edge, time, error, count);
    for (Py_ssize_t at = 0; at < count; at++) {
        float lit_sigma = ends.lit_sigma[at], dark_sigma = ends.dark_sigma[at];
        float late = (float)crossed[at], longer = duration[at] > 1 ? duration[at] : 1;
        float scatter = sqrtf(lit_sigma * lit_sigma + dark_sigma * dark_sigma) / 2;
        float soft = within((duration[at] - edge->sharp) / edge->soft, 0, 1);
        float both = (lost[at] > 0) & (left[at] > 0) ? 1 : 0;
        soft = soft > both ? soft : both;
        float own = time[at] + soft * (straight[at] - time[at]);
        time[at] = within(own, late - 1, late);
        error[at] += soft * (longer * scatter + edge->least_between - error[at]);
    }
    for (Py_ssize_t at = 0; at < count; at++) {
        float own = time[at], of_own = error[at];
        time[at] = crossed[at] > 0 ? own : NAN;
        error[at] = crossed[at] > 0 ? of_own : INFINITY;
    }
}

/* Hold arrays of 4 bytes an item and as many items, which are counted at the first; None, where
 * it may be, is NULL. Whether they are what is wanted; if not, an error is set. */
static int hold_all(held_t *held, PyObject *arrays, int wanted, int flags, void **parts,
                    Py_ssize_t *count)
{
    if (PyTuple_Size(arrays) != wanted)
        PyErr_SetString(PyExc_ValueError, "not as many arrays");
    for (int index = 0; index < wanted && !PyErr_Occurred(); index++) {
        PyObject *item = PyTuple_GetItem(arrays, index);
        parts[index] = NULL;
        if (item == Py_None && (index == DARK_ROUGH || index == LIT_ROUGH))
            continue;
        parts[index] = hold_as_many(held, item, 4, 1, flags, count);
    }
    return !PyErr_Occurred();
}

static PyObject *py_catch(PyObject *module, PyObject *arguments)
{
    PyObject *crossings, *found, *counts;
    held_t held = {0};
    void *parts[CROSSING], *outs[3];
    Py_ssize_t count = -1;
    noise_t noise;
    float enough, chosen;
    (void)module;
    if (!PyArg_ParseTuple(arguments, "O!O!Offfff", &PyTuple_Type, &crossings, &PyTuple_Type,
                          &found, &counts, &noise.slope, &noise.floor, &noise.beyond, &enough,
                          &chosen))
        return NULL;
    const Py_buffer *counted = hold(&held, counts, 8, PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE);
    if (counted && counted->len != 8 * 2 * BINS)
        PyErr_SetString(PyExc_ValueError, "not as many counts");
    if (counted && hold_all(&held, crossings, CROSSING, 0, parts, &count) &&
        hold_all(&held, found, 3, PyBUF_WRITABLE, outs, &count)) {
        caught_t caught = {outs[0], outs[1], outs[2], counted->buf};
        Py_BEGIN_ALLOW_THREADS
        for (Py_ssize_t start = 0; start < count; start += TOGETHER) {
            Py_ssize_t own = count - start < TOGETHER ? count - start : TOGETHER;
            catch(parts, start, own, &noise, enough, chosen, &caught);
        }
        Py_END_ALLOW_THREADS
    }
    return let_go(&held);
}

static PyObject *py_tell(PyObject *module, PyObject *arguments)
{
    PyObject *crossings, *caught, *found;
    held_t held = {0};
    void *parts[CROSSING], *ins[3], *outs[2];
    Py_ssize_t count = -1;
    noise_t noise;
    edge_t edge;
    (void)module;
    if (!PyArg_ParseTuple(arguments, "O!O!O!fffffffff", &PyTuple_Type, &crossings, &PyTuple_Type,
                          &caught, &PyTuple_Type, &found, &noise.slope, &noise.floor,
                          &noise.beyond, &edge.profile, &edge.least, &edge.least_between,
                          &edge.interval, &edge.sharp, &edge.soft))
        return NULL;
    if (hold_all(&held, crossings, CROSSING, 0, parts, &count) &&
        hold_all(&held, caught, 3, 0, ins, &count) &&
        hold_all(&held, found, 2, PyBUF_WRITABLE, outs, &count)) {
        const float *lost = ins[0], *left = ins[1], *duration = ins[2];
        float *time = outs[0], *error = outs[1];
        Py_BEGIN_ALLOW_THREADS
        for (Py_ssize_t start = 0; start < count; start += TOGETHER) {
            Py_ssize_t own = count - start < TOGETHER ? count - start : TOGETHER;
            tell(parts, start, own, &noise, &edge, lost + start, left + start, duration + start,
                 time + start, error + start);
        }
        Py_END_ALLOW_THREADS
    }
    return let_go(&held);
}

static PyMethodDef methods[] = {
    {"catch", py_catch, METH_VARARGS,
     "catch(crossings, found, counts, slope, floor, beyond, enough, chosen)\n\n"
     "crossings is at, before, after, lowest, highest, and the roughness of the last two or None;\n"
     "found, which is written to, what was lost, what was left, and the fall between; counts,\n"
     "(2, 50) int64, is added to."},
    {"tell", py_tell, METH_VARARGS,
     "tell(crossings, caught, found, slope, floor, beyond, profile, least, least_between, interval,\n"
     "sharp, soft)\n\n"
     "crossings as of catch; caught is what was lost, what was left, and how long edges take;\n"
     "found, which is written to, times and errors."},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "_own_times", NULL, 0, methods, NULL, NULL, NULL, NULL,
};

PyMODINIT_FUNC PyInit__own_times(void)
{
    return PyModule_Create(&definition);
}
