/* Undoes OpenEXR's ZIP for all chunks of a picture, without Python in between.
 *
 * Before a chunk is deflated its bytes are sorted, those at even places before those at odd ones,
 * and each but the first is stored as its difference to the one before, plus 128. To add them up
 * again is a running sum of bytes, for which numpy has no fast way, and which OpenEXR as it is
 * built for Python does byte by byte.
 */

#define PY_SSIZE_T_CLEAN
#define Py_LIMITED_API 0x030B0000
#include <Python.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#ifdef __SSE2__
#include <emmintrin.h>
#endif

/* What is added up over so many bytes: the sum of their differences, without the 128 of each. */
static uint8_t total(const uint8_t *bytes, Py_ssize_t size)
{
    uint8_t sum = 0;
    Py_ssize_t at = 0;
#ifdef __SSE2__
    __m128i sums = _mm_setzero_si128();
    for (; at + 16 <= size; at += 16)
        sums = _mm_add_epi8(sums, _mm_loadu_si128((const __m128i *)(bytes + at)));
    /* Sixteen times 128 is nothing to a byte. */
    sums = _mm_sad_epu8(sums, _mm_setzero_si128());
    sum = (uint8_t)(_mm_cvtsi128_si32(sums) + _mm_extract_epi16(sums, 4));
#endif
    for (; at < size; at++)
        sum = (uint8_t)(sum + bytes[at] - 128);
    return sum;
}

#ifdef __SSE2__
/* Sixteen bytes added up, from what comes before them on; it becomes the last in every place. */
static inline __m128i added_up(const uint8_t *bytes, __m128i *before)
{
    __m128i sums = _mm_loadu_si128((const __m128i *)bytes);
    sums = _mm_xor_si128(sums, _mm_set1_epi8((char)128));
    sums = _mm_add_epi8(sums, _mm_slli_si128(sums, 1));
    sums = _mm_add_epi8(sums, _mm_slli_si128(sums, 2));
    sums = _mm_add_epi8(sums, _mm_slli_si128(sums, 4));
    sums = _mm_add_epi8(sums, _mm_slli_si128(sums, 8));
    __m128i result = _mm_add_epi8(sums, *before);
    /* Only one addition waits for the round before. */
    __m128i last = _mm_srli_si128(sums, 15);
    last = _mm_shufflelo_epi16(_mm_unpacklo_epi8(last, last), 0);
    *before = _mm_add_epi8(*before, _mm_unpacklo_epi64(last, last));
    return result;
}
#endif

/* The bytes of a chunk as they were: both halves added up, and put at even and odd places. */
static void restore(const uint8_t *sorted, uint8_t *target, Py_ssize_t size)
{
    Py_ssize_t pairs = size / 2, at = 0;
    const uint8_t *even = sorted, *odd = sorted + (size + 1) / 2;
    /* One half goes on where the other ends. */
    uint8_t last_even = 128, last_odd = (uint8_t)(128 + total(even, (size + 1) / 2));
#ifdef __SSE2__
    __m128i before_even = _mm_set1_epi8((char)last_even);
    __m128i before_odd = _mm_set1_epi8((char)last_odd);
    for (; at + 16 <= pairs; at += 16) {
        __m128i first = added_up(even + at, &before_even);
        __m128i second = added_up(odd + at, &before_odd);
        __m128i *place = (__m128i *)(target + 2 * at);
        _mm_storeu_si128(place, _mm_unpacklo_epi8(first, second));
        _mm_storeu_si128(place + 1, _mm_unpackhi_epi8(first, second));
    }
    last_even = (uint8_t)_mm_cvtsi128_si32(before_even);
    last_odd = (uint8_t)_mm_cvtsi128_si32(before_odd);
#endif
    for (; at < pairs; at++) {
        target[2 * at] = last_even = (uint8_t)(last_even + even[at] - 128);
        target[2 * at + 1] = last_odd = (uint8_t)(last_odd + odd[at] - 128);
    }
    if (size % 2)
        target[size - 1] = (uint8_t)(last_even + even[pairs] - 128);
}

/* OpenEXR's exr_uncompress_buffer: context, source, target, and how much came of it. */
typedef int32_t (*inflate_t)(const void *, const void *, size_t, void *, size_t, size_t *);

/* Which rows a picture has, and how they lie in a file. */
typedef struct {
    int32_t top;       /* the number of the first row */
    Py_ssize_t rows;   /* in a chunk */
    Py_ssize_t length; /* bytes of a row */
} layout_t;

/* How many chunks from the first on are whole, and where they should be. */
static Py_ssize_t unzip(inflate_t inflate, const Py_buffer *data, const Py_buffer *table,
                        const Py_buffer *target, const layout_t *layout, uint8_t *scratch)
{
    const uint8_t *file = data->buf;
    Py_ssize_t chunks = table->len / 8, size = layout->rows * layout->length, chunk;
    for (chunk = 0; chunk < chunks && chunk * size < target->len; chunk++) {
        /* Its place in the file; there, the number of its first row and how much is stored. */
        uint64_t start;
        int32_t number, stored;
        memcpy(&start, (const uint8_t *)table->buf + 8 * chunk, 8);
        if (data->len < 8 || start > (uint64_t)data->len - 8)
            return chunk;
        memcpy(&number, file + start, 4);
        memcpy(&stored, file + start + 4, 4);
        start += 8;
        if (number != layout->top + chunk * layout->rows || stored < 1 ||
            (uint64_t)stored > (uint64_t)data->len - start)
            return chunk;
        uint8_t *bytes = (uint8_t *)target->buf + chunk * size;
        Py_ssize_t left = target->len - chunk * size, expected = left < size ? left : size;
        size_t inflated = 0;
        if (stored == expected) {
            memcpy(bytes, file + start, (size_t)expected);
            continue;
        }
        if (!inflate ||
            inflate(NULL, file + start, (size_t)stored, scratch, (size_t)expected, &inflated) ||
            inflated != (size_t)expected)
            return chunk;
        restore(scratch, bytes, expected);
    }
    return chunk;
}

static PyObject *py_unzip(PyObject *module, PyObject *arguments)
{
    PyObject *address;
    Py_buffer data, table, target;
    layout_t layout;
    Py_ssize_t done = 0;
    (void)module;
    if (!PyArg_ParseTuple(arguments, "O!y*y*w*inn", &PyLong_Type, &address, &data, &table, &target,
                          &layout.top, &layout.rows, &layout.length))
        return NULL;
    inflate_t inflate = (inflate_t)PyLong_AsVoidPtr(address);
    uint8_t *scratch = NULL;
    if (!PyErr_Occurred() && (layout.rows < 1 || layout.length < 1))
        PyErr_SetString(PyExc_ValueError, "chunks without rows, or rows without bytes");
    if (!PyErr_Occurred()) {
        Py_ssize_t size = layout.rows * layout.length;
        /* One byte more, as of nothing there may be no memory. */
        scratch = malloc((size_t)(size < target.len ? size : target.len) + 1);
        if (!scratch)
            PyErr_NoMemory();
    }
    if (!PyErr_Occurred()) {
        Py_BEGIN_ALLOW_THREADS
        done = unzip(inflate, &data, &table, &target, &layout, scratch);
        Py_END_ALLOW_THREADS
    }
    free(scratch);
    PyBuffer_Release(&data);
    PyBuffer_Release(&table);
    PyBuffer_Release(&target);
    return PyErr_Occurred() ? NULL : PyLong_FromSsize_t(done);
}

static PyMethodDef methods[] = {
    {"unzip", py_unzip, METH_VARARGS,
     "unzip(inflate, data, table, target, top, rows, length): how many chunks from the first on\n"
     "are whole.\n\n"
     "inflate is the address of OpenEXR's exr_uncompress_buffer, or 0 for chunks that are stored\n"
     "as they are; table holds each one's place in data as uint64. Into target go rows of so many\n"
     "bytes, so many of them from each chunk; the first has the number top."},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "_unzip", NULL, 0, methods, NULL, NULL, NULL, NULL,
};

PyMODINIT_FUNC PyInit__unzip(void)
{
    return PyModule_Create(&definition);
}
