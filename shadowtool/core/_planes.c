/* What `_trusted`, `_moments`, `_solve` and `_choose` of plane_fits.py do, row after row. */

#include "_arrays.h"
#include <math.h>
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
        agree[at] = (apart <= 0) | (apart * apart <= allowed[at] + allowed_other[at + dx]);
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

/* Sums over a cell's pixels in a row or column, times the powers 0, 1 and 2 of their places counted
 * from its middle; pixels on either side of it are taken together first. */
static inline void powers(const double *parts, int size, double *sums)
{
    if (size == 2) {
        double both = parts[1] + parts[0];
        sums[0] = both;
        sums[1] = (parts[1] - parts[0]) * 0.5;
        sums[2] = both * 0.25;
    } else {
        double inner = parts[2] + parts[1], outer = parts[3] + parts[0];
        sums[0] = inner + outer;
        sums[1] = (parts[2] - parts[1]) * 0.5 + (parts[3] - parts[0]) * 1.5;
        sums[2] = inner * 0.25 + outer * 2.25;
    }
}

/* How many moments there are; and how many sums down a cell's columns they are made of: of weights
 * by the powers of y, of weighted values by two of them, of their squares, and of pixels. */
enum { DOWN = 7, MOMENTS = 11 };

/* Sums down the columns of a row of cells, whose rows of pixels these are. */
static inline void add_down(const double *const *value, const double *const *weight, int size,
                            double *restrict down, Py_ssize_t stride, Py_ssize_t width)
{
    for (Py_ssize_t at = 0; at < width; at++) {
        double once[4], weighted[4], twice[4], used[4], sums[3];
        for (int row = 0; row < size; row++) {
            once[row] = weight[row][at];
            weighted[row] = once[row] * value[row][at];
            twice[row] = weighted[row] * value[row][at];
            used[row] = once[row] > 0 ? 1 : 0;
        }
        powers(once, size, sums);
        down[at] = sums[0];
        down[at + stride] = sums[1];
        down[at + 2 * stride] = sums[2];
        powers(weighted, size, sums);
        down[at + 3 * stride] = sums[0];
        down[at + 4 * stride] = sums[1];
        powers(twice, size, sums);
        down[at + 5 * stride] = sums[0];
        powers(used, size, sums);
        down[at + 6 * stride] = sums[0];
    }
}

/* The moments of a row of cells: 1, x, y, x², xy, y²; 1, x, y; 1; 1. `plane` is how far one lies
 * from the next. */
static inline void add_across(const double *down, Py_ssize_t stride, int size, double *moments,
                              Py_ssize_t plane, Py_ssize_t cells)
{
    for (Py_ssize_t cell = 0; cell < cells; cell++) {
        const double *parts = down + cell * size;
        double *own = moments + cell, sums[DOWN][3];
        for (int part = 0; part < DOWN; part++)
            powers(parts + part * stride, size, sums[part]);
        own[0] = sums[0][0];
        own[plane] = sums[0][1];
        own[2 * plane] = sums[1][0];
        own[3 * plane] = sums[0][2];
        own[4 * plane] = sums[1][1];
        own[5 * plane] = sums[2][0];
        own[6 * plane] = sums[3][0];
        own[7 * plane] = sums[3][1];
        own[8 * plane] = sums[4][0];
        own[9 * plane] = sums[5][0];
        own[10 * plane] = sums[6][0];
    }
}

typedef struct {
    const double *value, *weight;
    Py_ssize_t height, width;
    double *moments;
    Py_ssize_t rows, columns;
} cells_t;

/* Room is for the sums down a row of cells, and for a row of nothing after them. */
static inline void add_up(const cells_t *cells, int size, double *room)
{
    Py_ssize_t stride = cells->columns * size, plane = cells->rows * cells->columns;
    const double *nothing = room + DOWN * stride;
    for (Py_ssize_t row = 0; row < cells->rows; row++) {
        const double *value[4], *weight[4];
        for (int part = 0; part < size; part++) {
            Py_ssize_t own = row * size + part;
            value[part] = own < cells->height ? cells->value + own * cells->width : nothing;
            weight[part] = own < cells->height ? cells->weight + own * cells->width : nothing;
        }
        add_down(value, weight, size, room, stride, cells->width);
        add_across(room, stride, size, cells->moments + row * cells->columns, plane,
                   cells->columns);
    }
}

/* The parts of `_Planes`. */
enum { A, B, C, R, P, PX, PY, Q, QY, PLANES };

/* As of `_solve`; the rest are its constants, and the weight besides that of measurements. */
typedef struct {
    double factor, radius, weight, level, floor, misfit;
} terms_t;

static inline double larger(double one, double other)
{
    return one > other ? one : other;
}

/* So many pixels' planes are worked out together, side by side. */
enum { TOGETHER = 256 };

/* The planes of so many pixels, from the sums over their windows that begin there. */
static inline void solve_some(const double *const *sums, float (*planes)[TOGETHER],
                              Py_ssize_t first_pixel, Py_ssize_t count, terms_t terms)
{
    const double *part[MOMENTS];
    for (int index = 0; index < MOMENTS; index++)
        part[index] = sums[index] + first_pixel;
    for (Py_ssize_t at = 0; at < count; at++) {
        double wx = part[1][at], wy = part[2][at], wv = part[6][at], used = part[10][at];
        /* About the weighted mean. */
        double inverse = 1 / (part[0][at] + terms.weight);
        double x = wx * inverse, y = wy * inverse, v = wv * inverse;
        double wxx = part[3][at] + terms.level - wx * x, wxy = part[4][at] - wx * y;
        double wyy = part[5][at] + terms.level - wy * y;
        double wvx = part[7][at] - x * wv, wvy = part[8][at] - y * wv, wvv = part[9][at] - v * wv;
        double second = 1 / larger(wyy, terms.level), slant = wxy * second;
        double first = 1 / larger(wxx - slant * wxy, terms.level);
        double b = first * (wvx - slant * wvy), c = second * wvy - slant * b;
        double misfit = (wvv - (b * wvx + c * wvy)) / larger(used - 3, 1);
        double worse = larger(misfit, 1) * terms.factor;
        double p = sqrt(first * worse), q = sqrt(second * worse), px = p * terms.radius;
        float alone = (float)(inverse * worse + terms.floor);
        planes[A][at] = (float)(v - (b * x + c * y));
        planes[B][at] = (float)(b * terms.radius);
        planes[C][at] = (float)(c * terms.radius);
        planes[R][at] = (misfit >= terms.misfit) | (used < 4) ? INFINITY : alone;
        planes[P][at] = (float)(p * (slant * y - x));
        planes[PX][at] = (float)px;
        planes[PY][at] = (float)-(slant * px);
        planes[Q][at] = (float)-(q * y);
        planes[QY][at] = (float)(q * terms.radius);
    }
}

static void solve(const double *const *sums, float *const *planes, Py_ssize_t count, terms_t terms)
{
    float some[PLANES][TOGETHER];
    for (Py_ssize_t at = 0; at < count; at += TOGETHER) {
        Py_ssize_t left = count - at < TOGETHER ? count - at : TOGETHER;
        solve_some(sums, some, at, left, terms);
        for (int part = 0; part < PLANES; part++)
            memcpy(planes[part] + at, some[part], (size_t)left * sizeof **some);
    }
}

/* The parts of a choice: those of `_Planes`, and then those of `_Choice`. */
enum { VALUE = PLANES, VARIANCE, LEAST, MOST, ALL };

typedef struct {
    float *parts[ALL];
    /* Of the rows that were fitted. */
    Py_ssize_t width, height;
    /* Pixels to a cell; from a window's middle to its neighbours'; the choice's first row among
     * those fitted. */
    Py_ssize_t size, radius, first;
    /* So many standard deviations still agree. */
    float agrees;
} choice_t;

/* Planes at one y, and between what the value has to lie. The variance at x is rest +
 * (lean + x PX)². */
typedef struct {
    float *value, *rest, *lean, *least, *most;
} lines_t;

/* Take the lines, at 0 or one radius to the left or right, where they are known better. */
static inline void take(const choice_t *choice, const lines_t *lines, Py_ssize_t cell, int side,
                        Py_ssize_t from, float *restrict best, float *restrict spread,
                        Py_ssize_t start, Py_ssize_t count)
{
    const float *restrict value = lines->value + from, *restrict lean = lines->lean + from;
    const float *restrict rest = lines->rest + from;
    const float *restrict slope = choice->parts[B] + cell + from;
    const float *restrict growth = choice->parts[PX] + cell + from;
    const float *restrict least = lines->least + start, *restrict most = lines->most + start;
    for (Py_ssize_t at = 0; at < count; at++) {
        float own = value[at], leant = lean[at];
        if (side > 0) {
            own += slope[at];
            leant += growth[at];
        } else if (side < 0) {
            own -= slope[at];
            leant -= growth[at];
        }
        float of_own = rest[at] + leant * leant;
        float before = best[start + at], of_before = spread[start + at];
        int better = (of_own < of_before) & (own >= least[at]) & (own <= most[at]);
        best[start + at] = better ? own : before;
        spread[start + at] = better ? of_own : of_before;
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
            float alone = part[Q][at] + y * part[QY][at];
            lines->value[at] = part[A][at] + y * part[C][at];
            lines->rest[at] = part[R][at] + alone * alone;
            lines->lean[at] = part[P][at] + y * part[PY][at];
        }
        for (int dx = -1; dx <= 1; dx++) {
            Py_ssize_t ahead = dx * radius, start = ahead < 0 ? -ahead : 0;
            Py_ssize_t count = width - (ahead < 0 ? -ahead : ahead), from = start + ahead;
            if (count <= 0)
                continue;
            if (dx < 0)
                take(choice, lines, cell, 1, from, best, spread, start, count);
            else if (dx > 0)
                take(choice, lines, cell, -1, from, best, spread, start, count);
            else
                take(choice, lines, cell, 0, from, best, spread, start, count);
        }
    }
}

static PyObject *py_trust(PyObject *module, PyObject *arguments)
{
    PyObject *arrays[3];
    held_t held = {0};
    int least;
    float near;
    int32_t *room = NULL;
    (void)module;
    if (!PyArg_ParseTuple(arguments, "OOOfi", arrays, arrays + 1, arrays + 2, &near, &least))
        return NULL;
    const Py_buffer *value = hold(&held, arrays[0], 4, PyBUF_C_CONTIGUOUS);
    const Py_buffer *allowed = hold(&held, arrays[1], 4, PyBUF_C_CONTIGUOUS);
    const Py_buffer *trusted = hold(&held, arrays[2], 1, PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE);
    if (trusted && (value->ndim != 2 || !alike(allowed, value) || !alike(trusted, value))) {
        PyErr_SetString(PyExc_ValueError, "no pictures of one size");
    } else if (trusted && value->len) {
        Py_ssize_t height = value->shape[0], width = value->shape[1];
        if ((room = malloc((size_t)(3 * width + 1) * sizeof *room))) {
            Py_BEGIN_ALLOW_THREADS
            trust(value->buf, allowed->buf, trusted->buf, height, width, near, least, room);
            Py_END_ALLOW_THREADS
        } else {
            PyErr_NoMemory();
        }
    }
    free(room);
    return let_go(&held);
}

static PyObject *py_add_up(PyObject *module, PyObject *arguments)
{
    PyObject *arrays[3];
    held_t held = {0};
    int size;
    double *room = NULL;
    (void)module;
    if (!PyArg_ParseTuple(arguments, "OOOi", arrays, arrays + 1, arrays + 2, &size))
        return NULL;
    const Py_buffer *value = hold(&held, arrays[0], 8, PyBUF_C_CONTIGUOUS);
    const Py_buffer *weight = hold(&held, arrays[1], 8, PyBUF_C_CONTIGUOUS);
    const Py_buffer *moments = hold(&held, arrays[2], 8, PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE);
    int fit = moments && (size == 2 || size == 4) && value->ndim == 2 && alike(weight, value) &&
              moments->ndim == 3 && moments->shape[0] == MOMENTS;
    for (int side = 0; fit && side < 2; side++) {
        Py_ssize_t length = value->shape[side];
        fit = moments->shape[1 + side] == length / size + (length % size > 0);
    }
    if (fit && value->len) {
        cells_t cells = {value->buf, weight->buf, value->shape[0], value->shape[1],
                         moments->buf, moments->shape[1], moments->shape[2]};
        size_t count = (size_t)((DOWN + 1) * cells.columns * size + 1);
        if ((room = calloc(count, sizeof *room))) {
            Py_BEGIN_ALLOW_THREADS
            if (size == 2)
                add_up(&cells, 2, room);
            else
                add_up(&cells, 4, room);
            Py_END_ALLOW_THREADS
        } else {
            PyErr_NoMemory();
        }
    } else if (moments && !fit) {
        PyErr_SetString(PyExc_ValueError, "no pictures of one size, or not as many cells");
    }
    free(room);
    return let_go(&held);
}

static PyObject *py_solve(PyObject *module, PyObject *arguments)
{
    PyObject *given, *planes;
    held_t held = {0};
    terms_t terms;
    const double *sums[MOMENTS];
    float *parts[PLANES];
    int fit;
    (void)module;
    if (!PyArg_ParseTuple(arguments, "O!O!dddddd", &PyTuple_Type, &given, &PyTuple_Type, &planes,
                          &terms.factor, &terms.radius, &terms.weight, &terms.level, &terms.floor,
                          &terms.misfit))
        return NULL;
    fit = PyTuple_Size(given) == MOMENTS && PyTuple_Size(planes) == PLANES;
    for (int part = 0; fit && part < MOMENTS; part++) {
        const Py_buffer *own = hold(&held, PyTuple_GetItem(given, part), 8, PyBUF_C_CONTIGUOUS);
        fit = own && alike(own, held.views);
        sums[part] = own ? own->buf : NULL;
    }
    for (int part = 0; fit && part < PLANES; part++) {
        const Py_buffer *own = hold(&held, PyTuple_GetItem(planes, part), 4,
                                    PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE);
        fit = own && alike(own, held.views);
        parts[part] = own ? own->buf : NULL;
    }
    if (fit) {
        Py_BEGIN_ALLOW_THREADS
        solve(sums, parts, held.views->len / 8, terms);
        Py_END_ALLOW_THREADS
    } else if (!PyErr_Occurred()) {
        PyErr_SetString(PyExc_ValueError, "sums and planes that don't fit together");
    }
    return let_go(&held);
}

static PyObject *py_choose(PyObject *module, PyObject *arguments)
{
    PyObject *planes, *chosen;
    held_t held = {0};
    choice_t choice;
    float *room = NULL;
    int fit;
    (void)module;
    if (!PyArg_ParseTuple(arguments, "O!O!nnnnf", &PyTuple_Type, &planes, &PyTuple_Type, &chosen,
                          &choice.height, &choice.size, &choice.radius, &choice.first,
                          &choice.agrees))
        return NULL;
    fit = PyTuple_Size(planes) == PLANES && PyTuple_Size(chosen) == ALL - PLANES &&
          choice.height >= 0 && choice.size > 0 && choice.radius > 0 &&
          choice.radius <= INT32_MAX && choice.first >= 0 && choice.first <= INT32_MAX;
    for (int part = 0; fit && part < ALL; part++) {
        PyObject *item =
            part < PLANES ? PyTuple_GetItem(planes, part) : PyTuple_GetItem(chosen, part - PLANES);
        int writable = part == VALUE || part == VARIANCE ? PyBUF_WRITABLE : 0;
        const Py_buffer *own = hold(&held, item, 4, PyBUF_C_CONTIGUOUS | writable);
        fit = own && own->ndim == 2 && alike(own, held.views + (part < PLANES ? A : VALUE));
        choice.parts[part] = own ? own->buf : NULL;
    }
    const Py_buffer *first = held.views + A, *value = held.views + VALUE;
    fit = fit && value->shape[1] == first->shape[1] &&
          choice.height / choice.size + (choice.height % choice.size > 0) <= first->shape[0];
    if (!fit && !PyErr_Occurred())
        PyErr_SetString(PyExc_ValueError, "planes or a choice that don't fit together");
    if (fit && first->len && value->len) {
        Py_ssize_t width = choice.width = first->shape[1];
        if ((room = malloc((size_t)(5 * width + 1) * sizeof *room))) {
            lines_t lines = {room, room + width, room + 2 * width, room + 3 * width,
                             room + 4 * width};
            Py_BEGIN_ALLOW_THREADS
            for (Py_ssize_t row = 0; row < value->shape[0]; row++)
                choose_row(&choice, &lines, row);
            Py_END_ALLOW_THREADS
        } else {
            PyErr_NoMemory();
        }
    }
    free(room);
    return let_go(&held);
}

static PyMethodDef methods[] = {
    {"add_up", py_add_up, METH_VARARGS,
     "add_up(value, weight, moments, size)\n\n"
     "The moments of cells of 2 or 4 pixels squared: value and weight, (H, W), and moments,\n"
     "(11, h, w), which is written to, double floats."},
    {"trust", py_trust, METH_VARARGS,
     "trust(value, allowed, trusted, near, least)\n\n"
     "Which measurements agree with at least so many of the eight around them: value and allowed,\n"
     "(H, W) single floats; trusted, (H, W) bool, is written to."},
    {"solve", py_solve, METH_VARARGS,
     "solve(sums, planes, factor, radius, weight, level, floor, misfit)\n\n"
     "The planes of sums over windows: eleven arrays of one shape, double floats. planes is a\n"
     "`_Planes` of that shape, single floats, which is written to. factor and floor are squared."},
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
