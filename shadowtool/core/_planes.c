/* What `_trusted` and `_choose` of plane_fits.py do, row after row. */

#define PY_SSIZE_T_CLEAN
#define Py_LIMITED_API 0x030B0000
#include <Python.h>
#include <math.h>
#include <stdint.h>
#include <stdlib.h>

/* Add to the counts of two rows where a measurement and the one dx further on in the other row
 * agree: they are no further apart, but for what is near, than the root of what is allowed both. */
static inline void compare(const float *restrict one, const float *restrict allowed,
                           const float *restrict other, const float *restrict allowed_other,
                           int dx, float near, int32_t *counts, int32_t *counts_other,
                           int32_t *restrict agree, Py_ssize_t width)
{
    Py_ssize_t start = dx < 0 ? -dx : 0, stop = dx > 0 ? width - dx : width;
    for (Py_ssize_t at = start; at < stop; at++) {
        float apart = fabsf(one[at] - other[at + dx]) - near;
        /* NaN is apart from all. */
        apart = apart < 0 ? 0 : apart;
        agree[at] = apart * apart <= allowed[at] + allowed_other[at + dx];
    }
    for (Py_ssize_t at = start; at < stop; at++)
        counts[at] += agree[at];
    for (Py_ssize_t at = start; at < stop; at++)
        counts_other[at + dx] += agree[at];
}

/* Room is for three rows. */
static void trust(const float *value, const float *allowed, uint8_t *trusted, Py_ssize_t height,
                  Py_ssize_t width, float near, int least, int32_t *room)
{
    int32_t *here = room, *below = room + width, *agree = room + 2 * width;
    for (Py_ssize_t at = 0; at < width; at++)
        here[at] = below[at] = 0;
    for (Py_ssize_t row = 0; row < height; row++) {
        const float *own = value + row * width, *of_own = allowed + row * width;
        compare(own, of_own, own, of_own, 1, near, here, here, agree, width);
        if (row + 1 < height)
            for (int dx = -1; dx <= 1; dx++)
                compare(own, of_own, own + width, of_own + width, dx, near, here, below, agree,
                        width);
        for (Py_ssize_t at = 0; at < width; at++)
            trusted[row * width + at] = here[at] >= least;
        int32_t *done = here;
        here = below;
        below = done;
        for (Py_ssize_t at = 0; at < width; at++)
            below[at] = 0;
    }
}

/* The parts of `_Planes`, and of `_Choice`. */
enum { A, B, C, AA, AB, AC, BB, BC, CC, PLANES };
enum { VALUE = PLANES, VARIANCE, LEAST, MOST, ALL };

typedef struct {
    float *parts[ALL];
    /* Of the choice, and of the rows that were fitted. */
    Py_ssize_t rows, width, height;
    /* Pixels to a cell; from a window's middle to its neighbours'; the choice's first row among
     * those fitted. */
    Py_ssize_t size, radius, first;
    /* So many standard deviations still agree. */
    float agrees;
} choice_t;

/* Planes at one y, and between what the value has to lie. */
typedef struct {
    float *value, *variance, *slope, *least, *most;
} lines_t;

/* Take the lines, at 0 or one radius to the left or right, where they are known better. */
static inline void take(const float *restrict value, const float *restrict slope,
                        const float *restrict variance, const float *restrict mixed,
                        const float *restrict square, int side, const lines_t *lines,
                        float *restrict best, float *restrict spread, Py_ssize_t start,
                        Py_ssize_t count)
{
    const float *restrict least = lines->least + start, *restrict most = lines->most + start;
    for (Py_ssize_t at = 0; at < count; at++) {
        float own = value[at], of_own = variance[at];
        if (side > 0) {
            own += slope[at];
            of_own += mixed[at];
            of_own += square[at];
        } else if (side < 0) {
            own -= slope[at];
            of_own -= mixed[at];
            of_own += square[at];
        }
        float before = best[at], of_before = spread[at];
        int better = (of_own < of_before) & (own >= least[at]) & (own <= most[at]);
        best[at] = better ? own : before;
        spread[at] = better ? of_own : of_before;
    }
}

static void choose_row(const choice_t *choice, const lines_t *lines, Py_ssize_t row)
{
    Py_ssize_t width = choice->width, radius = choice->radius, here = row * width;
    float *best = choice->parts[VALUE] + here, *spread = choice->parts[VARIANCE] + here;
    for (Py_ssize_t at = 0; at < width; at++) {
        /* What smaller windows told. */
        float allowed = sqrtf(spread[at]) * choice->agrees;
        float low = best[at] - allowed, high = best[at] + allowed;
        float least = choice->parts[LEAST][here + at], most = choice->parts[MOST][here + at];
        lines->least[at] = least > low ? least : low;
        lines->most[at] = most < high ? most : high;
    }
    for (int dy = -1; dy <= 1; dy++) {
        /* The window's centre lies (dx, dy) ahead, so the pixel lies (-dx, -dy) off it. */
        Py_ssize_t there = choice->first + row + dy * radius;
        if (there < 0 || there >= choice->height)
            continue;
        Py_ssize_t cell = there / choice->size * width;
        float middle = (float)(choice->size - 1) / 2;
        float y = ((float)(there % choice->size) - middle) / (float)radius - (float)dy;
        const float *part[PLANES];
        for (int index = 0; index < PLANES; index++)
            part[index] = choice->parts[index] + cell;
        for (Py_ssize_t at = 0; at < width; at++) {
            lines->value[at] = part[A][at] + y * part[C][at];
            lines->variance[at] = part[AA][at] + y * (part[AC][at] + y * part[CC][at]);
            lines->slope[at] = part[AB][at] + y * part[BC][at];
        }
        for (int dx = -1; dx <= 1; dx++) {
            Py_ssize_t ahead = dx * radius, start = ahead < 0 ? -ahead : 0;
            Py_ssize_t count = width - (ahead < 0 ? -ahead : ahead), from = start + ahead;
            if (count <= 0)
                continue;
            const float *value = lines->value + from, *variance = lines->variance + from;
            const float *slope = part[B] + from, *mixed = lines->slope + from;
            const float *square = part[BB] + from;
            float *own = best + start, *of_own = spread + start;
            if (dx < 0)
                take(value, slope, variance, mixed, square, 1, lines, own, of_own, start, count);
            else if (dx > 0)
                take(value, slope, variance, mixed, square, -1, lines, own, of_own, start, count);
            else
                take(value, slope, variance, mixed, square, 0, lines, own, of_own, start, count);
        }
    }
}

static PyObject *py_choose(PyObject *module, PyObject *arguments)
{
    PyObject *planes, *chosen;
    Py_buffer views[ALL];
    choice_t choice;
    int held = 0;
    float *room = NULL;
    (void)module;
    if (!PyArg_ParseTuple(arguments, "O!O!nnnnf", &PyTuple_Type, &planes, &PyTuple_Type, &chosen,
                          &choice.height, &choice.size, &choice.radius, &choice.first,
                          &choice.agrees))
        return NULL;
    if (PyTuple_Size(planes) != PLANES || PyTuple_Size(chosen) != ALL - PLANES ||
        choice.height < 0 || choice.size < 1 || choice.radius < 1)
        PyErr_SetString(PyExc_ValueError, "no planes, or none to choose");
    while (!PyErr_Occurred() && held < ALL) {
        PyObject *item =
            held < PLANES ? PyTuple_GetItem(planes, held) : PyTuple_GetItem(chosen, held - PLANES);
        int writable = held == VALUE || held == VARIANCE;
        if (PyObject_GetBuffer(item, views + held,
                               PyBUF_C_CONTIGUOUS | (writable ? PyBUF_WRITABLE : 0)))
            break;
        const Py_buffer *own = views + held, *first = views + (held < PLANES ? A : VALUE);
        if (own->ndim != 2 || own->itemsize != 4 || own->shape[0] != first->shape[0] ||
            own->shape[1] != views->shape[1])
            PyErr_SetString(PyExc_ValueError, "parts are no pictures of one size");
        choice.parts[held++] = own->buf;
    }
    if (!PyErr_Occurred()) {
        choice.rows = views[VALUE].shape[0];
        choice.width = views->shape[1];
        if ((choice.height + choice.size - 1) / choice.size > views->shape[0])
            PyErr_SetString(PyExc_ValueError, "planes of fewer cells than were fitted");
        else if (!(room = malloc((size_t)(5 * choice.width + 1) * sizeof *room)))
            PyErr_NoMemory();
    }
    if (room) {
        lines_t lines = {room, room + choice.width, room + 2 * choice.width,
                         room + 3 * choice.width, room + 4 * choice.width};
        Py_BEGIN_ALLOW_THREADS
        for (Py_ssize_t row = 0; row < choice.rows; row++)
            choose_row(&choice, &lines, row);
        Py_END_ALLOW_THREADS
    }
    free(room);
    while (held > 0)
        PyBuffer_Release(&views[--held]);
    if (PyErr_Occurred())
        return NULL;
    Py_RETURN_NONE;
}

static PyObject *py_trust(PyObject *module, PyObject *arguments)
{
    PyObject *arrays[3];
    Py_buffer views[3];
    int held = 0, least;
    float near;
    int32_t *room = NULL;
    (void)module;
    if (!PyArg_ParseTuple(arguments, "OOOfi", arrays, arrays + 1, arrays + 2, &near, &least))
        return NULL;
    while (held < 3 && !PyErr_Occurred()) {
        if (PyObject_GetBuffer(arrays[held], views + held,
                               PyBUF_C_CONTIGUOUS | (held == 2 ? PyBUF_WRITABLE : 0)))
            break;
        const Py_buffer *own = views + held++;
        if (own->ndim != 2 || own->itemsize != (held == 3 ? 1 : 4) ||
            own->shape[0] != views->shape[0] || own->shape[1] != views->shape[1])
            PyErr_SetString(PyExc_ValueError, "no pictures of one size");
    }
    if (!PyErr_Occurred()) {
        Py_ssize_t height = views->shape[0], width = views->shape[1];
        if ((room = malloc((size_t)(3 * width + 1) * sizeof *room))) {
            Py_BEGIN_ALLOW_THREADS
            trust(views[0].buf, views[1].buf, views[2].buf, height, width, near, least, room);
            Py_END_ALLOW_THREADS
        } else {
            PyErr_NoMemory();
        }
    }
    free(room);
    while (held > 0)
        PyBuffer_Release(&views[--held]);
    if (PyErr_Occurred())
        return NULL;
    Py_RETURN_NONE;
}

static PyMethodDef methods[] = {
    {"trust", py_trust, METH_VARARGS,
     "trust(value, allowed, trusted, near, least)\n\n"
     "Which measurements agree with at least so many of the eight around them: value and allowed,\n"
     "(H, W) single floats; trusted, (H, W) bool, is written to."},
    {"choose", py_choose, METH_VARARGS,
     "choose(planes, chosen, height, size, radius, first, agrees)\n\n"
     "Replace what was chosen where a plane is known better. planes is a `_Planes`, for so many\n"
     "rows of pixels, so many to a cell; chosen is a `_Choice`, whose value and variance are\n"
     "written to, and whose first row is one of those rows. Windows are a radius apart, and so many\n"
     "standard deviations still agree."},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "_planes", NULL, 0, methods, NULL, NULL, NULL, NULL,
};

PyMODINIT_FUNC PyInit__planes(void)
{
    return PyModule_Create(&definition);
}
