/* Looks at frames of a pass for pixels that cross their threshold in them: what `_look` of
 * crossings.py does, and how it says why, one pixel after the other and without Python in between.
 */

#include "_arrays.h"

/* The key of NaN, beyond all others; and one below all others. */
#define UNKNOWN 0x7E00
#define LOWEST (-0x8000)
/* So many pixels are looked at together, which lets the compiler take several at a time; few, as
 * frames are then fetched side by side. */
#define TOGETHER 128

/* What is known of each pixel: `_State`. */
typedef struct {
    int16_t *low, *high, *lower;
    int32_t *at;
    int16_t *after, *before, *earlier, *floor;
    uint8_t *lost;
} state_t;
#define PARTS 9
static const Py_ssize_t SIZES[PARTS] = {2, 2, 2, 4, 2, 2, 2, 2, 1};

typedef struct {
    /* Keys of all pixels, of frames that were seen before and, after these, of new ones. */
    const int16_t **frames;
    Py_ssize_t seen, all;
    /* The first frame's number. */
    Py_ssize_t first;
    /* What keeps this part of its light, or loses less than so many keys, crosses nothing. */
    float nearly_lit;
    int16_t nearly_lit_keys;
} pass_t;

/* The key of a value rounded to a half. */
static inline int16_t key_of(float value)
{
    uint32_t sign, half = bits_of_value(value, &sign);
    /* Halfs are sign and magnitude: see half_keys.py. */
    return (int16_t)(sign ? (half | 0x8000) ^ 0x7FFF : half);
}

/* What a finite half's key stands for. */
static inline float value_of(int16_t key)
{
    uint32_t half = key < 0 ? (uint32_t)key ^ 0x7FFF : (uint32_t)key;
    float value = value_of_bits(half & 0x7FFF, 1);
    return key < 0 ? -value : value;
}

/* The threshold's key. */
static inline int16_t midway(int16_t low, float lit)
{
    return key_of((value_of(low) + lit) / 2);
}

/* Whether a pixel that falls by many small steps is lost, and not found again as it falls at once.
 * Aged: its crossing found last is too long ago to look up what came after it. */
static uint8_t creep(const state_t *state, const pass_t *pass, Py_ssize_t pixel, float lit,
                     int aged)
{
    int16_t low = state->low[pixel], after = state->after[pixel];
    uint8_t lost = state->lost[pixel];
    int passed = 0;
    for (Py_ssize_t row = pass->seen; row < pass->all; row++) {
        int16_t value = pass->frames[row][pixel];
        if (value >= low)
            continue;
        int16_t threshold = midway(value, lit);
        if (low >= threshold) {
            lost = 0;
            passed = 1;
        } else if (!passed && after >= threshold) {
            lost |= (uint8_t)aged;
            passed = 1;
        }
        low = value;
    }
    return lost;
}

/* Move a pixel's crossing to the first later frame that is below the threshold, or of which one
 * before it is: the first two of the frames from `start` on are for what comes before it alone.
 * `old` is where among all frames the crossing found last is, `after` its luminance, and `floor`
 * the lowest before it. */
static void search(const state_t *state, const pass_t *pass, Py_ssize_t pixel, int16_t threshold,
                   Py_ssize_t start, Py_ssize_t old, int16_t after, int16_t floor)
{
    Py_ssize_t since = old + 1 > start ? old + 1 : start;
    Py_ssize_t found = since;
    while (found < pass->all - 1 && pass->frames[found][pixel] >= threshold)
        found++;
    if (found < start + 2)
        found = start + 2;
    if (found >= pass->all)
        return;
    if (found - 2 >= old)
        floor = least(floor, after);
    for (Py_ssize_t row = since; row <= found - 2; row++)
        floor = least(floor, pass->frames[row][pixel]);
    state->floor[pixel] = floor;
    state->at[pixel] = (int32_t)(pass->first + found);
    state->after[pixel] = pass->frames[found][pixel];
    state->before[pixel] = pass->frames[found - 1][pixel];
    state->earlier[pixel] = pass->frames[found - 2][pixel];
}

/* A pixel that is darker than ever may cross its threshold. */
static void look(const state_t *state, const pass_t *pass, Py_ssize_t pixel, int16_t low)
{
    float lit = value_of(state->high[pixel]);
    int16_t threshold = midway(low, lit), nearly_lit = key_of(pass->nearly_lit * lit);
    int16_t before = state->low[pixel], after = state->after[pixel];
    if (low >= nearly_lit || after < threshold)
        return;
    Py_ssize_t old = state->at[pixel] - pass->first, last = pass->seen - 1;
    if (before >= least(threshold, nearly_lit)) {
        int aged = before < nearly_lit && old < 1;
        if (aged || state->lost[pixel])
            state->lost[pixel] = creep(state, pass, pixel, lit, aged);
        /* As if it had crossed in the frame before. */
        after = pass->frames[last][pixel];
        search(state, pass, pixel, threshold, last - 1, last, after, state->lower[pixel]);
    } else {
        int16_t floor = least(state->floor[pixel], state->before[pixel]);
        state->lost[pixel] |= old < 1;
        search(state, pass, pixel, threshold, 0, old, after, floor);
    }
}

/* Some pixels' lowest and highest with the new frames, and the lowest without the last of them. */
static void extremes(const pass_t *pass, Py_ssize_t start, Py_ssize_t count, int16_t *lower,
                     int16_t *low, int16_t *high)
{
    for (Py_ssize_t row = pass->seen; row < pass->all; row++) {
        const int16_t *frame = pass->frames[row] + start;
        if (row == pass->all - 1)
            memcpy(lower, low, 2 * (size_t)count);
        for (Py_ssize_t at = 0; at < count; at++) {
            low[at] = least(low[at], frame[at]);
            high[at] = most(high[at], frame[at] == UNKNOWN ? LOWEST : frame[at]);
        }
    }
}

static void settle(const state_t *state, const pass_t *pass, Py_ssize_t pixels)
{
    int16_t lower[TOGETHER], low[TOGETHER], high[TOGETHER], darker[TOGETHER];
    for (Py_ssize_t start = 0; start < pixels; start += TOGETHER) {
        Py_ssize_t count = pixels - start < TOGETHER ? pixels - start : TOGETHER;
        size_t size = 2 * (size_t)count;
        int16_t any = 0;
        const int16_t *before = state->low + start, *after = state->after + start;
        memcpy(low, before, size);
        memcpy(high, state->high + start, size);
        extremes(pass, start, count, lower, low, high);
        memcpy(state->high + start, high, size);
        for (Py_ssize_t at = 0; at < count; at++) {
            int16_t nearly_lit = (int16_t)(high[at] - pass->nearly_lit_keys);
            int16_t middle = (int16_t)((low[at] >> 1) + (high[at] >> 1));
            darker[at] = (low[at] < before[at]) & (low[at] < nearly_lit) &
                         ((low[at] < 0) | (after[at] >= middle));
        }
        for (Py_ssize_t at = 0; at < count; at++)
            any |= darker[at];
        for (Py_ssize_t at = 0; any && at < count; at++)
            if (darker[at])
                look(state, pass, start + at, low[at]);
        memcpy(state->lower + start, lower, size);
        memcpy(state->low + start, low, size);
    }
}

static PyObject *py_settle(PyObject *module, PyObject *arguments)
{
    PyObject *parts, *frames;
    Py_buffer *views = NULL;
    const int16_t **data = NULL;
    pass_t pass = {0};
    Py_ssize_t held = 0, pixels = 0;
    int keys;
    (void)module;
    if (!PyArg_ParseTuple(arguments, "O!O!nnfi", &PyTuple_Type, &parts, &PyList_Type, &frames,
                          &pass.seen, &pass.first, &pass.nearly_lit, &keys))
        return NULL;
    pass.all = PyList_Size(frames);
    pass.nearly_lit_keys = (int16_t)keys;
    if (PyTuple_Size(parts) != PARTS || pass.seen < 3 || pass.all <= pass.seen) {
        PyErr_SetString(PyExc_ValueError, "no state, or no frames");
    } else {
        views = PyMem_Calloc((size_t)(PARTS + pass.all), sizeof *views);
        data = PyMem_Calloc((size_t)pass.all, sizeof *data);
        if (!views || !data)
            PyErr_NoMemory();
    }
    while (!PyErr_Occurred() && held < PARTS + pass.all) {
        int part = held < PARTS;
        PyObject *item = part ? PyTuple_GetItem(parts, held) : PyList_GetItem(frames, held - PARTS);
        if (PyObject_GetBuffer(item, &views[held], part ? PyBUF_WRITABLE : PyBUF_SIMPLE))
            break;
        pixels = views[0].len / SIZES[0];
        if (views[held].len != pixels * (part ? SIZES[held] : 2))
            PyErr_SetString(PyExc_ValueError, "a part of the state, or a frame, is too small");
        if (!part)
            data[held - PARTS] = views[held].buf;
        held++;
    }
    if (!PyErr_Occurred()) {
        state_t state = {views[0].buf, views[1].buf, views[2].buf, views[3].buf, views[4].buf,
                         views[5].buf, views[6].buf, views[7].buf, views[8].buf};
        pass.frames = data;
        Py_BEGIN_ALLOW_THREADS
        settle(&state, &pass, pixels);
        Py_END_ALLOW_THREADS
    }
    while (held > 0)
        PyBuffer_Release(&views[--held]);
    PyMem_Free(views);
    PyMem_Free(data);
    if (PyErr_Occurred())
        return NULL;
    Py_RETURN_NONE;
}

static PyMethodDef methods[] = {
    {"settle", py_settle, METH_VARARGS,
     "settle(state, frames, seen, first, nearly_lit, nearly_lit_keys)\n\n"
     "Look at frames for crossings. state is a `_State`, whose arrays are written to. Of the\n"
     "frames, keys of all pixels each, so many were seen before; the first of all has the number\n"
     "first. A pixel that keeps the part nearly_lit of its light, or loses less than so many keys,\n"
     "crosses nothing."},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "_crossings", NULL, 0, methods, NULL, NULL, NULL, NULL,
};

PyMODINIT_FUNC PyInit__crossings(void)
{
    return PyModule_Create(&definition);
}
