/* Luminance of half floats: what `luminance_halfs` of shadow_time.py does, in one go. */

#define PY_SSIZE_T_CLEAN
#define Py_LIMITED_API 0x030B0000
#include <Python.h>
#include <stdint.h>
#include <string.h>
#if defined(__x86_64__) && defined(__GNUC__)
#define HAS_WIDE
#include <immintrin.h>
#endif

/* A half's value. */
static inline float value_of(uint16_t half)
{
    uint32_t bits = (uint32_t)(half & 0x7FFF) << 13, sign = (uint32_t)(half & 0x8000) << 16;
    float value;
    if ((half & 0x7C00) == 0x7C00) {
        bits |= 0x7F800000;
        memcpy(&value, &bits, 4);
    } else {
        memcpy(&value, &bits, 4);
        /* From one kind's bias of the exponent to the other's. */
        value *= 0x1p112f;
        memcpy(&bits, &value, 4);
    }
    bits |= sign;
    memcpy(&value, &bits, 4);
    return value;
}

/* A value rounded to a half. */
static inline uint16_t half_of(float value)
{
    uint32_t bits, sign, half;
    memcpy(&bits, &value, 4);
    sign = bits >> 16 & 0x8000;
    bits &= 0x7FFFFFFF;
    if (bits > 0x7F800000) {
        half = 0x7E00;
    } else if (bits >= 0x477FF000) {
        half = 0x7C00;
    } else if (bits < 0x38800000) {
        /* Not normal: to the last place of a half's sum with this half, which is the same. */
        memcpy(&value, &bits, 4);
        value += 0.5f;
        memcpy(&bits, &value, 4);
        half = bits - 0x3F000000;
    } else {
        /* To the nearest, or the even one of two, with the other kind's bias of the exponent. */
        half = (bits + 0xFFF + (bits >> 13 & 1) - 0x38000000) >> 13;
    }
    return (uint16_t)(sign | half);
}

/* Weights of red, green and blue, and a row of each. */
typedef struct {
    float weights[3];
    const uint16_t *red, *green, *blue;
    uint16_t *out;
} row_t;

#ifdef HAS_WIDE
/* Eight at a time, where the processor converts halfs itself: how many are done. Products and sums
 * are rounded each for itself, as everywhere. */
__attribute__((target("avx2,f16c"))) static Py_ssize_t eights(const row_t *row, Py_ssize_t width)
{
    const __m256 of_red = _mm256_set1_ps(row->weights[0]);
    const __m256 of_green = _mm256_set1_ps(row->weights[1]);
    const __m256 of_blue = _mm256_set1_ps(row->weights[2]);
    Py_ssize_t at = 0;
    for (; at + 8 <= width; at += 8) {
        __m256 red = _mm256_cvtph_ps(_mm_loadu_si128((const __m128i *)(row->red + at)));
        __m256 green = _mm256_cvtph_ps(_mm_loadu_si128((const __m128i *)(row->green + at)));
        __m256 blue = _mm256_cvtph_ps(_mm_loadu_si128((const __m128i *)(row->blue + at)));
        __m256 sum = _mm256_add_ps(_mm256_mul_ps(red, of_red), _mm256_mul_ps(green, of_green));
        sum = _mm256_add_ps(sum, _mm256_mul_ps(blue, of_blue));
        __m128i halfs = _mm256_cvtps_ph(sum, _MM_FROUND_TO_NEAREST_INT);
        _mm_storeu_si128((__m128i *)(row->out + at), halfs);
    }
    return at;
}
#endif

static void luminance(const row_t *row, Py_ssize_t width, int wide)
{
    Py_ssize_t at = 0;
#ifdef HAS_WIDE
    if (wide)
        at = eights(row, width);
#else
    (void)wide;
#endif
    for (; at < width; at++) {
        float red = value_of(row->red[at]) * row->weights[0];
        float green = value_of(row->green[at]) * row->weights[1];
        float blue = value_of(row->blue[at]) * row->weights[2];
        float sum = red + green;
        row->out[at] = half_of(sum + blue);
    }
}

static PyObject *py_luminance(PyObject *module, PyObject *arguments)
{
    PyObject *arrays[4];
    Py_buffer views[4];
    row_t row;
    int held = 0, wide = 0;
    (void)module;
    if (!PyArg_ParseTuple(arguments, "OOOOfff", arrays, arrays + 1, arrays + 2, arrays + 3,
                          row.weights, row.weights + 1, row.weights + 2))
        return NULL;
    while (held < 4) {
        int flags = PyBUF_STRIDES | (held == 3 ? PyBUF_WRITABLE : 0);
        if (PyObject_GetBuffer(arrays[held], views + held, flags))
            break;
        const Py_buffer *own = views + held++;
        if (own->ndim != 2 || own->itemsize != 2 || own->strides[1] != 2 ||
            own->shape[0] != views->shape[0] || own->shape[1] != views->shape[1]) {
            PyErr_SetString(PyExc_ValueError, "no rows of halfs, or not as many");
            break;
        }
    }
    if (!PyErr_Occurred()) {
#ifdef HAS_WIDE
        wide = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("f16c");
#endif
        Py_BEGIN_ALLOW_THREADS
        for (Py_ssize_t y = 0; y < views->shape[0]; y++) {
            const char *starts[4];
            for (int part = 0; part < 4; part++)
                starts[part] = (const char *)views[part].buf + y * views[part].strides[0];
            row.red = (const uint16_t *)starts[0];
            row.green = (const uint16_t *)starts[1];
            row.blue = (const uint16_t *)starts[2];
            row.out = (uint16_t *)starts[3];
            luminance(&row, views->shape[1], wide);
        }
        Py_END_ALLOW_THREADS
    }
    while (held > 0)
        PyBuffer_Release(&views[--held]);
    if (PyErr_Occurred())
        return NULL;
    Py_RETURN_NONE;
}

static PyMethodDef methods[] = {
    {"luminance", py_luminance, METH_VARARGS,
     "luminance(red, green, blue, out, of_red, of_green, of_blue)\n\n"
     "Sums of halfs, (H, W) each, rows of which may lie apart, by their weights."},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "_luminance", NULL, 0, methods, NULL, NULL, NULL, NULL,
};

PyMODINIT_FUNC PyInit__luminance(void)
{
    return PyModule_Create(&definition);
}
