/* What `SampledLevels` and `RobustPlates` of robust_plates.py do with frames: several at a time, so
 * that what is known of a pixel is fetched once for all of them. */

#include "_arrays.h"
#include <math.h>

/* The gray key of what is not seen, and one below all that is. */
#define UNSEEN 32767
#define LOWEST (-32000)
/* So many pixels are looked at together, which lets the compiler take several at a time; few, as
 * frames are then fetched side by side. And so many have all their keys added up, or none, or are
 * told apart. */
#define TOGETHER 128
#define RUN 16

/* How many of the highest and of the lowest keys are kept. */
enum { KEPT = 3 };

/* Take in some pixels' gray keys. */
static void sample(const int16_t *gray, int16_t *const *highest, int16_t *const *lowest,
                   Py_ssize_t start, Py_ssize_t count)
{
    int16_t high[TOGETHER], low[TOGETHER];
    for (Py_ssize_t at = 0; at < count; at++) {
        low[at] = gray[start + at];
        high[at] = low[at] == UNSEEN ? LOWEST : low[at];
    }
    for (int place = 0; place < KEPT; place++) {
        int16_t *restrict held = highest[place] + start, *restrict under = lowest[place] + start;
        for (Py_ssize_t at = 0; at < count; at++) {
            int16_t lower = least(held[at], high[at]), higher = most(under[at], low[at]);
            held[at] = most(held[at], high[at]);
            under[at] = least(under[at], low[at]);
            high[at] = lower;
            low[at] = higher;
        }
    }
}

/* `_Group`: of each pixel. */
typedef struct {
    float *frames, *gray, *total;
} group_t;

/* `RobustPlates`. */
typedef struct {
    const int16_t *lit_low, *lit_high, *dark, *shaded_low, *shaded_high, *deep;
    const float *near;
    int32_t *count;
    float *total;
    group_t lowest, next;
} plates_t;

/* Add up the keys of those of some pixels that are wanted, 1 and not 0. */
static void accumulate(const int16_t *keys, const int16_t *wanted, float *restrict total,
                       Py_ssize_t count)
{
    for (Py_ssize_t start = 0; start < count; start += RUN) {
        Py_ssize_t stop = count - start < RUN ? count : start + RUN;
        int16_t all = 0;
        for (Py_ssize_t at = start; at < stop; at++)
            all = (int16_t)(all + wanted[at]);
        if (all == RUN) {
            for (Py_ssize_t at = 3 * start; at < 3 * (start + RUN); at++)
                total[at] += (float)keys[at];
        } else if (all) {
            for (Py_ssize_t at = start; at < stop; at++)
                if (wanted[at])
                    for (Py_ssize_t part = 3 * at; part < 3 * at + 3; part++)
                        total[part] += (float)keys[part];
        }
    }
}

/* Let a pixel's group be one frame alone. */
static inline void begin(const group_t *group, Py_ssize_t pixel, float gray, const int16_t *keys)
{
    group->frames[pixel] = 1;
    group->gray[pixel] = gray;
    for (int part = 0; part < 3; part++)
        group->total[3 * pixel + part] = (float)keys[part];
}

static inline void join(const group_t *group, Py_ssize_t pixel, float distance,
                        const int16_t *keys)
{
    group->frames[pixel] += 1;
    group->gray[pixel] += distance / group->frames[pixel];
    for (int part = 0; part < 3; part++)
        group->total[3 * pixel + part] += (float)keys[part];
}

/* Let a darkened pixel join, found or pass over groups: `RobustPlates._found`. */
static void found(const plates_t *plates, Py_ssize_t pixel, int16_t gray_key, const int16_t *keys,
                  float least_group)
{
    const group_t *lowest = &plates->lowest, *next = &plates->next;
    float gray = (float)gray_key - (float)UNSEEN, near = plates->near[pixel];
    float distance = gray - lowest->gray[pixel];
    /* Of those of which it is known, the next group is what is shaded. */
    int unknown = plates->shaded_low[pixel] > plates->shaded_high[pixel];
    if (fabsf(distance) <= near) {
        join(lowest, pixel, distance, keys);
    } else if (distance < 0) {
        if (unknown && lowest->frames[pixel] > 0) {
            next->frames[pixel] = lowest->frames[pixel];
            next->gray[pixel] = lowest->gray[pixel];
            memcpy(next->total + 3 * pixel, lowest->total + 3 * pixel, 3 * sizeof(float));
        }
        begin(lowest, pixel, gray, keys);
    } else if (unknown && lowest->frames[pixel] < least_group) {
        distance = gray - next->gray[pixel];
        if (fabsf(distance) <= near)
            join(next, pixel, distance, keys);
        else if (distance < 0)
            begin(next, pixel, gray, keys);
    }
}

/* Take in some pixels of a frame. */
static void add(const plates_t *plates, const int16_t *keys, const int16_t *gray,
                Py_ssize_t start, Py_ssize_t count, float least_group)
{
    int16_t own[TOGETHER], wanted[TOGETHER], any = 0;
    memcpy(own, gray + start, 2 * (size_t)count);
    const int16_t *low = plates->lit_low + start, *high = plates->lit_high + start;
    const int16_t *dark = plates->dark + start;
    keys += 3 * start;
    for (Py_ssize_t at = 0; at < count; at++) {
        wanted[at] = (own[at] >= low[at]) & (own[at] <= high[at]);
        any |= own[at] < dark[at];
    }
    int32_t *counted = plates->count + start;
    for (Py_ssize_t at = 0; at < count; at++)
        counted[at] += wanted[at];
    accumulate(keys, wanted, plates->total + 3 * start, count);
    if (!any)
        return;
    low = plates->shaded_low + start;
    high = plates->shaded_high + start;
    float *frames = plates->next.frames + start;
    for (Py_ssize_t at = 0; at < count; at++)
        wanted[at] = (own[at] >= low[at]) & (own[at] <= high[at]);
    for (Py_ssize_t at = 0; at < count; at++)
        frames[at] += (float)wanted[at];
    accumulate(keys, wanted, plates->next.total + 3 * start, count);
    const int16_t *deep = plates->deep + start;
    for (Py_ssize_t at = 0; at < count; at++)
        if (own[at] < deep[at])
            found(plates, start + at, own[at], keys + 3 * at, least_group);
}

/* So many frames at most are taken in together. */
enum { FRAMES = 8 };

/* How many frames a tuple has, of so many parts each; none, with an error set, if it can't be. */
static int frames_of(PyObject *tuple, int parts)
{
    Py_ssize_t size = PyTuple_Size(tuple);
    if (size > 0 && size % parts == 0 && size / parts <= FRAMES)
        return (int)(size / parts);
    PyErr_SetString(PyExc_ValueError, "no frames, or too many");
    return 0;
}

static PyObject *py_sample(PyObject *module, PyObject *arguments)
{
    PyObject *frames, *kept;
    held_t held = {0};
    int16_t *highest[KEPT] = {0}, *lowest[KEPT] = {0};
    const int16_t *grays[FRAMES] = {0};
    Py_ssize_t pixels = -1;
    (void)module;
    if (!PyArg_ParseTuple(arguments, "O!O!", &PyTuple_Type, &frames, &PyTuple_Type, &kept))
        return NULL;
    int count = frames_of(frames, 1);
    for (int frame = 0; frame < count; frame++)
        grays[frame] = hold_as_many(&held, PyTuple_GetItem(frames, frame), 2, 1, 0, &pixels);
    for (int place = 0; place < 2 * KEPT; place++) {
        PyObject *item = PyTuple_GetItem(kept, place);
        int16_t **own = (place < KEPT ? highest : lowest) + place % KEPT;
        *own = hold_as_many(&held, item, 2, 1, PyBUF_WRITABLE, &pixels);
    }
    if (!PyErr_Occurred()) {
        Py_BEGIN_ALLOW_THREADS
        for (Py_ssize_t start = 0; start < pixels; start += TOGETHER)
            for (int frame = 0; frame < count; frame++)
                sample(grays[frame], highest, lowest, start,
                       pixels - start < TOGETHER ? pixels - start : TOGETHER);
        Py_END_ALLOW_THREADS
    }
    return let_go(&held);
}

static PyObject *py_add(PyObject *module, PyObject *arguments)
{
    PyObject *frames, *bounds, *near, *lit, *groups;
    held_t held = {0};
    const int16_t *keys[FRAMES] = {0}, *grays[FRAMES] = {0};
    void *bound[6] = {0}, *sums[2] = {0}, *group[6] = {0};
    Py_ssize_t pixels = -1;
    float least_group;
    (void)module;
    if (!PyArg_ParseTuple(arguments, "O!O!OO!O!f", &PyTuple_Type, &frames, &PyTuple_Type, &bounds,
                          &near, &PyTuple_Type, &lit, &PyTuple_Type, &groups, &least_group))
        return NULL;
    int count = frames_of(frames, 2);
    for (int frame = 0; frame < count; frame++) {
        PyObject *item = PyTuple_GetItem(frames, 2 * frame);
        keys[frame] = hold_as_many(&held, item, 2, 3, 0, &pixels);
        item = PyTuple_GetItem(frames, 2 * frame + 1);
        grays[frame] = hold_as_many(&held, item, 2, 1, 0, &pixels);
    }
    for (int place = 0; place < 6; place++)
        bound[place] = hold_as_many(&held, PyTuple_GetItem(bounds, place), 2, 1, 0, &pixels);
    const float *nearness = hold_as_many(&held, near, 4, 1, 0, &pixels);
    for (int place = 0; place < 2; place++) {
        PyObject *item = PyTuple_GetItem(lit, place);
        sums[place] = hold_as_many(&held, item, 4, place ? 3 : 1, PyBUF_WRITABLE, &pixels);
    }
    for (int place = 0; place < 6; place++) {
        PyObject *item = PyTuple_GetItem(groups, place);
        int each = place % 3 == 2 ? 3 : 1;
        group[place] = hold_as_many(&held, item, 4, each, PyBUF_WRITABLE, &pixels);
    }
    if (!PyErr_Occurred()) {
        plates_t plates = {bound[0], bound[1], bound[2], bound[3], bound[4], bound[5],
                           nearness, sums[0],  sums[1],  {group[0], group[1], group[2]},
                           {group[3], group[4], group[5]}};
        Py_BEGIN_ALLOW_THREADS
        for (Py_ssize_t start = 0; start < pixels; start += TOGETHER)
            for (int frame = 0; frame < count; frame++)
                add(&plates, keys[frame], grays[frame], start,
                    pixels - start < TOGETHER ? pixels - start : TOGETHER, least_group);
        Py_END_ALLOW_THREADS
    }
    return let_go(&held);
}

static PyMethodDef methods[] = {
    {"sample", py_sample, METH_VARARGS,
     "sample(grays, kept)\n\n"
     "Take in the gray keys of up to 8 frames; kept are the three highest and the three lowest,\n"
     "which are written to."},
    {"add", py_add, METH_VARARGS,
     "add(frames, bounds, near, lit, groups, least_group)\n\n"
     "Take in up to 8 frames, the keys and gray keys of each. bounds are the least and the highest\n"
     "gray key of what is lit, that below which it is darkened, the least and the highest of what\n"
     "is shaded, and that below which groups are founded. lit, its count and total, and groups,\n"
     "frames, gray and total of the lowest and of the next, are written to."},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "_robust_plates", NULL, 0, methods, NULL, NULL, NULL, NULL,
};

PyMODINIT_FUNC PyInit__robust_plates(void)
{
    return PyModule_Create(&definition);
}
