# cmake -DHEADERS=a;b -DOUT=FILE -P layout_hash.cmake
# Writes a header with LAYOUT_HASH, of the texts of the headers that declare the drive's memory: an A2L file of another
# layout has another one.
set(texts)
foreach(header ${HEADERS})
    file(SHA256 ${header} text)
    string(APPEND texts ${text})
endforeach()
string(SHA256 hash "${texts}")
string(SUBSTRING ${hash} 0 8 hash)
file(WRITE ${OUT} "#define LAYOUT_HASH 0x${hash}u\n")
