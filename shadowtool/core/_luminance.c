/* Luminance of half floats: what `luminance_halfs` of shadow_time.py does, in one go. */

#include "_arrays.h"
/* Older compilers can't ask for what is needed. */
#if defined(__x86_64__) && (defined(__clang__) ? __clang_major__ >= 18 : __GNUC__ >= 11)
#define HAS_WIDE
#include <immintrin.h>
#endif

static inline float value_of(uint16_t half)
{
    float value = value_of_bits(half & 0x7FFF, 0);
    return half & 0x8000 ? -value : value;
}

static inline uint16_t half_of(float value)
{
    uint32_t sign, half = bits_of_value(value, &sign);
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
    const Py_buffer *views[4];
    held_t held = {0};
    row_t row;
    int fit = 1, wide = 0;
    (void)module;
    if (!PyArg_ParseTuple(arguments, "OOOOfff", arrays, arrays + 1, arrays + 2, arrays + 3,
                          row.weights, row.weights + 1, row.weights + 2))
        return NULL;
    for (int part = 0; part < 4; part++) {
        int flags = PyBUF_STRIDES | (part == 3 ? PyBUF_WRITABLE : 0);
        views[part] = hold(&held, arrays[part], 2, flags);
        fit = fit && views[part] && views[part]->ndim == 2 && views[part]->strides[1] == 2 &&
              alike(views[part], views[0]);
    }
    if (!fit && !PyErr_Occurred())
        PyErr_SetString(PyExc_ValueError, "rows that are no rows, or not as many");
    if (fit) {
        Py_ssize_t height = views[0]->shape[0], width = views[0]->shape[1];
#ifdef HAS_WIDE
        wide = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("f16c");
#endif
        Py_BEGIN_ALLOW_THREADS
        for (Py_ssize_t y = 0; y < height; y++) {
            char *starts[4];
            for (int part = 0; part < 4; part++)
                starts[part] = (char *)views[part]->buf + y * views[part]->strides[0];
            row.red = (const uint16_t *)starts[0];
            row.green = (const uint16_t *)starts[1];
            row.blue = (const uint16_t *)starts[2];
            row.out = (uint16_t *)starts[3];
            luminance(&row, width, wide);
        }
        Py_END_ALLOW_THREADS
    }
    return let_go(&held);
}

static PyMethodDef methods[] = {
    {"luminance", py_luminance, METH_VARARGS,
     "luminance(red, green, blue, out, of_red, of_green, of_blue)\n\n"
     "Write to out the sums of halfs by their weights, (H, W) each; rows may lie apart."},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "_luminance", NULL, 0, methods, NULL, NULL, NULL, NULL,
};

PyMODINIT_FUNC PyInit__luminance(void)
{
    return PyModule_Create(&definition);
}
