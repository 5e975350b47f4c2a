/* What `Weighed.nearest` of color_line.py does, in one look at each colour. */

#include "_arrays.h"
#include <math.h>

/* So many colours are looked at together, which lets the compiler take several at a time. */
#define TOGETHER 256

/* Rows of three channels, so many numbers apart. */
typedef struct {
    const float *first;
    Py_ssize_t apart;
} channels_t;

/* Of some colours: how far they are from the line, and where on it the nearest point is. */
static void nearest(const channels_t *colours, const channels_t *weights, const channels_t *lit,
                    const channels_t *shadow, Py_ssize_t start, Py_ssize_t count,
                    float *restrict distance, float *restrict part)
{
    float direction[3][TOGETHER], rest[3][TOGETHER], along[TOGETHER], length[TOGETHER];
    for (int channel = 0; channel < 3; channel++) {
        const float *colour = colours->first + channel * colours->apart + start;
        const float *weight = weights->first + channel * weights->apart + start;
        const float *light = lit->first + channel * lit->apart + start;
        const float *shade = shadow->first + channel * shadow->apart + start;
        for (Py_ssize_t at = 0; at < count; at++) {
            float toward = (light[at] - shade[at]) * weight[at];
            float off = (colour[at] - shade[at]) * weight[at];
            direction[channel][at] = toward;
            rest[channel][at] = off;
            along[at] = channel ? along[at] + off * toward : off * toward;
            length[at] = channel ? length[at] + toward * toward : toward * toward;
        }
    }
    for (Py_ssize_t at = 0; at < count; at++) {
        /* NaN stays. */
        float span = length[at] < 1e-9f ? 1e-9f : length[at], place = along[at] / span;
        place = place < 0 ? 0 : place;
        place = place > 1 ? 1 : place;
        part[start + at] = place;
        float square = 0;
        for (int channel = 0; channel < 3; channel++) {
            float off = rest[channel][at] - direction[channel][at] * place;
            square = channel ? square + off * off : off * off;
        }
        float far = sqrtf(square);
        /* NaN is no distance. */
        far = far > 0 ? far : 0;
        distance[start + at] = far < 1e6f ? far : 1e6f;
    }
}

/* Hold three channels of as many colours as the first that is held. */
static int hold_channels(held_t *held, PyObject *array, channels_t *channels)
{
    const Py_buffer *own = hold(held, array, 4, PyBUF_STRIDES);
    if (!own)
        return 0;
    if (own->ndim != 2 || own->shape[0] != 3 || own->shape[1] != held->views[0].shape[1] ||
        (own->shape[1] > 1 && own->strides[1] != 4) || own->strides[0] % 4) {
        PyErr_SetString(PyExc_ValueError, "no three channels of as many colours");
        return 0;
    }
    channels->first = own->buf;
    channels->apart = own->strides[0] / 4;
    return 1;
}

static PyObject *py_nearest(PyObject *module, PyObject *arguments)
{
    PyObject *arrays[4], *found[2];
    held_t held = {0};
    channels_t channels[4];
    float *outs[2];
    int fit = 1;
    (void)module;
    if (!PyArg_ParseTuple(arguments, "OOOOOO", arrays, arrays + 1, arrays + 2, arrays + 3, found,
                          found + 1))
        return NULL;
    for (int place = 0; fit && place < 4; place++)
        fit = hold_channels(&held, arrays[place], channels + place);
    Py_ssize_t count = fit ? held.views[0].shape[1] : 0;
    for (int place = 0; fit && place < 2; place++) {
        outs[place] = hold_as_many(&held, found[place], 4, 1, PyBUF_WRITABLE, &count);
        fit = !PyErr_Occurred();
    }
    if (fit) {
        Py_BEGIN_ALLOW_THREADS
        for (Py_ssize_t start = 0; start < count; start += TOGETHER)
            nearest(channels, channels + 1, channels + 2, channels + 3, start,
                    count - start < TOGETHER ? count - start : TOGETHER, outs[0], outs[1]);
        Py_END_ALLOW_THREADS
    }
    return let_go(&held);
}

static PyMethodDef methods[] = {
    {"nearest", py_nearest, METH_VARARGS,
     "nearest(colours, weights, lit, shadow, distance, part)\n\n"
     "How far colours are from the lines between lit and shadow, by their weights, and where on\n"
     "them the nearest points are: (3, N) single floats each, whose rows may lie apart; the last\n"
     "two, (N,), are written to."},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "_color_line", NULL, 0, methods, NULL, NULL, NULL, NULL,
};

PyMODINIT_FUNC PyInit__color_line(void)
{
    return PyModule_Create(&definition);
}
